"""Real spherical harmonics, in the order and with the signs of 3D Gaussian splatting."""

from __future__ import annotations

import numpy as np

from cap4d.gaussians import SH_COUNTS
from cap4d.rotation import Array, namespace

SH_0 = 0.28209479177387814  # the one that all directions share
DIRECTIONS = 64  # to tell the harmonics of degree 3 apart, 16 would do


def sh_basis(directions: Array, degree: int) -> Array:
    """[V, (degree + 1)^2] of unit directions [V, 3], from the camera to the Gaussians."""
    xp = namespace(directions)
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [SH_0 * xp.ones_like(x)],
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
    ]
    return xp.stack([b for band in bands[: degree + 1] for b in band], 1)


def rotate_sh(sh: np.ndarray, rotmat: np.ndarray) -> np.ndarray:
    """float32[N, S, 3] coefficients whose colours in direction R d are those of `sh` in direction d.

    A rotation maps the harmonics of a degree to harmonics of that degree, exactly; the matrix of each is
    found from values in some directions.
    """
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degree, turned = SH_COUNTS[sh.shape[1]], np.array(sh, np.float32)
    before, after = sh_basis(directions, degree), sh_basis(directions @ rotmat.T, degree)
    for k in range(1, degree + 1):
        band = slice(k * k, (k + 1) ** 2)
        matrix = np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0]
        turned[:, band] = np.einsum("ij,njc->nic", matrix, sh[:, band].astype(np.float64))
    return turned
