"""How the neck bends: a capture's head stands still (fact 31), so the shoulders must turn the other way."""

from __future__ import annotations

import numpy as np

from cap4d.rig.head import HeadRig
from cap4d.rotation import axis_angle_to_rotmat, rotmat_to_axis_angle


def steady_neck(rig: HeadRig, shape: np.ndarray, rot: np.ndarray, tra: np.ndarray) -> np.ndarray:
    """The neck rotations that keep the shoulders where they are in the world while the head moves.

    Per frame the rotation R about the neck's joint J that brings R (v - J) nearest to where the resting
    shoulders are, seen from the moved head (Kabsch 1976, weighted by how much the joint moves each vertex).

    Args:
        shape: [S]; rot, tra: [T, 3] the head's pose in the world, rig axes.
    Returns:
        float64[T, 3] rad; zero for a rig whose neck does not bend.
    """
    if "neck" not in rig.joint_drivers:
        return np.zeros((len(rot), 3))
    joint = rig.joint_drivers.index("neck")
    weights = np.asarray(rig.skin_weights[:, joint], np.float64)
    chosen = np.flatnonzero(weights > 0.5)
    if not len(chosen):
        return np.zeros((len(rot), 3))
    subject = rig.subject(np.asarray(shape, np.float32))
    pivot = np.asarray(subject.joints[joint], np.float64)
    shoulders, weights = np.asarray(subject.neutral, np.float64)[chosen], weights[chosen]
    head = axis_angle_to_rotmat(np.asarray(rot, np.float64))
    rest = shoulders @ mean_rotation(head).T + tra.mean(0)
    seen_from_head = (rest - tra[:, None]) @ head  # R^T (x - t), [T, P, 3]
    correlation = np.einsum("tpi,pj,p->tij", seen_from_head - pivot, shoulders - pivot, weights)
    return rotmat_to_axis_angle(nearest_rotation(correlation))


def mean_rotation(rotmats: np.ndarray) -> np.ndarray:
    """[T, 3, 3] -> [3, 3], the rotation nearest to all of them (chordal mean)."""
    return nearest_rotation(rotmats.mean(0))


def nearest_rotation(matrices: np.ndarray) -> np.ndarray:
    """[..., 3, 3] -> the rotation R that maximises trace(R^T M)."""
    u, _, vt = np.linalg.svd(matrices)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt
