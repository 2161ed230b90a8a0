"""Gaussians as a .ply of 3D Gaussian splatting (Kerbl et al. 2023), which nearly every tool reads.

float32, little-endian; opacities as logits, scales as logarithms, quaternions wxyz, and spherical harmonics
channel by channel, always of degree 3 (its first readers accept no other). OpenCV's axes, as its captures
have. Nothing is lost but what float32's logit of an opacity near 1 cannot say.
"""

from __future__ import annotations

import numpy as np

from cap4d.export.axes import unit_quats
from cap4d.gaussians import Gaussians

N_REST = 15  # of degree 3, a channel
SMALLEST_SCALE = 1e-10  # m; a logarithm needs one
SMALLEST_OPACITY = 1e-7  # and as near to 1
FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * N_REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)


def ply_bytes(gaussians: Gaussians) -> bytes:
    """The file."""
    n, sh = len(gaussians), gaussians.sh
    rest = np.zeros((n, N_REST, 3), np.float32)
    rest[:, : sh.shape[1] - 1] = sh[:, 1:]
    opacities = np.clip(gaussians.opacities.astype(np.float64), SMALLEST_OPACITY, 1 - SMALLEST_OPACITY)
    columns = [
        gaussians.means,
        np.zeros((n, 3)),
        sh[:, 0],
        rest.swapaxes(1, 2).reshape(n, -1),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(np.maximum(gaussians.scales.astype(np.float64), SMALLEST_SCALE)),
        unit_quats(gaussians),
    ]
    return _header(n) + np.concatenate(columns, 1, dtype="<f4", casting="same_kind").tobytes()


def _header(n: int) -> bytes:
    properties = "".join(f"property float {name}\n" for name in FIELDS)
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n".encode()
