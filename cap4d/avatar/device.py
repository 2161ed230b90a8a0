"""Where a fit runs: the CPU with the C++ operators, or a CUDA device with torch and gsplat."""

from __future__ import annotations

from importlib.util import find_spec

import torch

from cap4d.errors import ArgumentError

DEVICES = ("auto", "cpu", "cuda")
GSPLAT = "gsplat (pip install gsplat)"


def device_named(name: str) -> torch.device:
    """`auto` is a CUDA device where torch finds one and gsplat is installed, else the CPU.

    Raises:
        ArgumentError: An unknown name, or `cuda` where something that it needs is missing.
    """
    if name not in DEVICES:
        raise ArgumentError(f"device: expected {', '.join(DEVICES)}, got {name!r}")
    missing = _missing_for_cuda()
    if name == "cuda" and missing:
        raise ArgumentError(f"device: cuda needs {missing}")
    return torch.device("cpu" if name == "cpu" or missing else "cuda")


def _missing_for_cuda() -> str | None:
    if not torch.cuda.is_available():
        return "a CUDA device, and torch finds none"
    return None if find_spec("gsplat") else GSPLAT
