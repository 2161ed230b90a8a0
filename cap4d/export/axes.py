"""Gaussians in another frame of reference: places, orientations, and what they look like from where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.camera import OPENCV_FROM_RIG
from cap4d.gaussians import Gaussians
from cap4d.harmonics import rotate_sh
from cap4d.rotation import quat_multiply, rotmat_to_quat


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


def unit_quats(gaussians: Gaussians) -> np.ndarray:
    """float64[N, 4] wxyz"""
    quats = gaussians.quats.astype(np.float64)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
