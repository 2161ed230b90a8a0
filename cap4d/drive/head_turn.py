"""A head that its sender turns: what of that belongs to the neck, the head and the eyes."""

from __future__ import annotations

import numpy as np

from cap4d.rotation import axis_angle_to_rotmat, rotmat_to_axis_angle


def turn(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray | float = 0.0) -> np.ndarray:
    """float32[..., 3] axis-angle in rig axes: roll first, then pitch, then yaw (rad).

    Positive: to the person's left, down, and the head's top to the person's right.
    """
    yaw, pitch, roll = np.broadcast_arrays(*(np.asarray(angle, np.float64) for angle in (yaw, pitch, roll)))
    about = [
        axis_angle_to_rotmat(angle[..., None] * axis)
        for angle, axis in zip((pitch, yaw, roll), np.eye(3), strict=True)
    ]
    return rotmat_to_axis_angle(about[1] @ about[0] @ about[2]).astype(np.float32)


def head_pose(rot: np.ndarray) -> dict[str, np.ndarray]:
    """`rot`, `tra` and `neck_rot` [..., 3] of a head that turns by `rot` about its origin over shoulders that
    stay: in the head's own frame these turn the other way.
    """
    return {"rot": rot, "tra": np.zeros_like(rot), "neck_rot": -rot}
