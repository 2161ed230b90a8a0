"""The networks that some metrics need, from the user: none of them may be passed on by us."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Weights:
    """Files of the user, None where there is none.

    Args:
        lpips: Folder with both files of LPIPS; None: the usual caches are looked into.
        arcface: ArcFace as ONNX, for CSIM.
        fan: FAN as ONNX, for AKD-fan.
        flame: A regressor of FLAME's parameters (DECA, SMIRK) as ONNX, for AED and APD.
    """

    lpips: Path | None = None
    arcface: Path | None = None
    fan: Path | None = None
    flame: Path | None = None
