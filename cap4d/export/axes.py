"""Gaussians in another frame of reference: places, orientations, and what they look like from where.

A rotation of the world rotates the directions that spherical harmonics are evaluated in, so their
coefficients turn, too: degree by degree, by a matrix that follows from the harmonics themselves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.camera import OPENCV_FROM_RIG
from cap4d.gaussians import Gaussians
from cap4d.rotation import quat_multiply, rotmat_to_quat

DIRECTIONS = 64  # to tell the harmonics of degree 3 apart, 16 would do


def y_up(gaussians: Gaussians) -> Gaussians:
    """From OpenCV's axes (y down, the face to -z) to x right, y up, z to the viewer, the face to +z."""
    return rotated(gaussians, OPENCV_FROM_RIG)  # its own inverse


def rotated(gaussians: Gaussians, rotmat: np.ndarray) -> Gaussians:
    """Gaussians that look from R d as these do from d, R float64[3, 3]."""
    turn = rotmat_to_quat(np.asarray(rotmat, np.float64))
    return replace(
        gaussians,
        means=(gaussians.means @ rotmat.T).astype(np.float32),
        quats=quat_multiply(turn, gaussians.quats.astype(np.float64)).astype(np.float32),
        sh=rotate_sh(gaussians.sh, rotmat),
    )


def rotate_sh(sh: np.ndarray, rotmat: np.ndarray) -> np.ndarray:
    """float32[N, S, 3] coefficients whose colours in direction R d are those of `sh` in direction d."""
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = sh_basis(directions), sh_basis(directions @ rotmat.T)
    turned, first = np.array(sh, np.float32), 1
    while first < sh.shape[1]:
        last = first + 2 * int(np.sqrt(first)) + 1
        band = slice(first, last)
        matrix = np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0]
        turned[:, band] = np.einsum("ij,njc->nic", matrix, sh[:, band].astype(np.float64))
        first = last
    return turned


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """float64[D, 16] real spherical harmonics of unit directions [D, 3], order and signs of 3DGS."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            0.28209479177387814 * np.ones_like(x),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        1,
    )


def unit_quats(gaussians: Gaussians) -> np.ndarray:
    """float64[N, 4] wxyz"""
    quats = gaussians.quats.astype(np.float64)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
