"""Mesa's software drivers, and a program run with each of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

DRIVERS = {
    "llvmpipe": {"LIBGL_ALWAYS_SOFTWARE": "1", "GALLIUM_DRIVER": "llvmpipe"},
    "zink": {"LIBGL_ALWAYS_SOFTWARE": "1", "MESA_LOADER_DRIVER_OVERRIDE": "zink"},
}
NO_DRIVER = 77  # exit code


def drawn_with(driver: str, program: str, output: Path) -> dict[str, np.ndarray]:
    """What `program` of this folder writes into `output`, an .npz, in a process of its own.

    A driver is chosen when its library is loaded. Skips the test where it is not installed.
    """
    here = Path(__file__).resolve().parent
    environment = os.environ | DRIVERS[driver] | {"PYTHONPATH": str(here.parent)}
    command = [sys.executable, here / program, output]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    if done.returncode == NO_DRIVER:
        pytest.skip(f"{driver}: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    found = dict(np.load(output))
    if driver not in str(found["driver"]):
        pytest.skip(f"{driver} is not installed: got {found['driver']}")
    return found


def context_or_exit():
    """An OpenGL context for such a program; where there is none, the program ends with NO_DRIVER."""
    from cap4d.app.gl_context import GlUnavailableError, headless_context

    try:
        return headless_context()
    except GlUnavailableError as error:
        print(error, file=sys.stderr)
        raise SystemExit(NO_DRIVER) from None
