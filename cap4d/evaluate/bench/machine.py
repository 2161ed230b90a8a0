"""What the numbers were measured on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cap4d import __version__, _core

CPUINFO = Path("/proc/cpuinfo")
PACKAGES = ("numpy", "onnxruntime", "torch", "gsplat")


def describe_machine(threads: int) -> dict[str, Any]:
    """Processor, cores, load, instruction set and versions."""
    return {
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "threads": threads,
        "load_1_min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "isa": _core.isa(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "cap4d": __version__,
        **{name: package_version(name) for name in PACKAGES},
    }


def processor_name(path: Path = CPUINFO) -> str:
    """As the system tells it."""
    try:
        lines = path.read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def package_version(name: str) -> str | None:
    """None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
