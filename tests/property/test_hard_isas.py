"""The hard cases again on every narrower instruction set, each in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cap4d import _core

HERE = Path(__file__).resolve().parent
HARD = [path for path in sorted(HERE.glob("test_hard_*.py")) if path.name != Path(__file__).name]


@pytest.mark.slow
@pytest.mark.parametrize("isa", ["base", "v3", "v4"])
def test_hard_cases_hold_on(isa: str) -> None:
    if isa == _core.isa():
        pytest.skip(f"{isa} is what this process runs: its own tests say")
    code = "from cap4d import _core; print(_core.isa())"
    environment = os.environ | {"CAP4D_ISA": isa}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    if run.stdout.strip() != isa:
        pytest.skip(f"this processor does not run {isa}, but {run.stdout.strip()}")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *map(str, HARD)]
    run = subprocess.run(command, env=environment, cwd=HERE.parents[1], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-4000:]
