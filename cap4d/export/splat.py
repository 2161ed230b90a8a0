"""Gaussians as a .splat: 32 bytes each, the most visible first; the small format of web viewers.

Positions and scales as float32, m; colour, opacity and quaternion in 8 bits each. The colour is that of no
direction in particular: whatever depends on the view is left out. OpenCV's axes, as the .ply it stems from.
"""

from __future__ import annotations

import numpy as np

from cap4d.export.axes import unit_quats
from cap4d.gaussians import Gaussians
from cap4d.harmonics import SH_0

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def splat_bytes(gaussians: Gaussians) -> bytes:
    """The file."""
    records = np.empty(len(gaussians), RECORD)
    records["mean"], records["scale"] = gaussians.means, gaussians.scales
    records["rgba"][:, :3] = _byte(255 * (0.5 + SH_0 * gaussians.sh[:, 0].astype(np.float64)))
    records["rgba"][:, 3] = _byte(255 * gaussians.opacities)
    records["quat"] = _byte(128 + 128 * unit_quats(gaussians))
    seen = gaussians.scales.prod(1, dtype=np.float64) * gaussians.opacities
    return records[np.argsort(-seen, kind="stable")].tobytes()


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
