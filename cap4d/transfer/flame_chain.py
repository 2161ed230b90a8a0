"""FLAME with its kinematic chain as a `Subject`, which has none: exact in the frame of the head.

FLAME turns its root about joint 0, on it the neck about joint 1, and on that the jaw and each eye about
joints 2 to 4 (Li et al. 2017). Seen from the head, which the neck carries, the root turns by the neck's
inverse about joint 1, jaw and eyes turn by themselves, and root and neck are the pose of the head:

    x_world = A_root A_neck x_head,  x_head = w_0 N^-1 x + w_1 x + w_2 J x + w_3 E_l x + w_4 E_r x.

That is a subject of four joints of their own (fact 7). Pose correctives are linear in N - I; the subject's
neck turns by N^-1, the transpose of N, so that its correctives are FLAME's with transposed entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.rig.flame import JOINTS, N_FILE_IDENTITY, FlameModel
from cap4d.rig.head import Subject
from cap4d.rotation import axis_angle_to_rotmat, rotmat_to_axis_angle

ROOT, NECK = 0, 1
N_EXPRESSIONS = 100  # of FLAME's own
TRANSPOSED = np.arange(9).reshape(3, 3).T.ravel()


@dataclass(frozen=True, eq=False)
class HeadMotion:
    """The head's pose in FLAME's world, T frames: rotations float64[T, 3, 3] and translations [T, 3] m."""

    rotations: np.ndarray
    translations: np.ndarray


def head_subject(flame: FlameModel, neutral: np.ndarray, name: str) -> Subject:
    """A person in the frame of the head.

    Pose it with `neck_rot` the negative of FLAME's neck pose, `jaw_rot` and `eye_rot` FLAME's own.

    Args:
        neutral: float64[V, 3] m: the template with the person's identity, without expression.
        name: Of the rig.
    """
    expressions = _expressions(flame)
    slots = [slot for slot, _ in JOINTS.values()]  # whose skin weights
    pivots = flame.joint_regressor[[NECK, *slots[1:]]]
    correctives = flame.posedirs.transpose(2, 0, 1).copy()
    correctives[:9] = correctives[TRANSPOSED]
    arrays = {
        "neutral": neutral,
        "expression_basis": expressions,
        "joints": pivots @ neutral,
        "joints_expression": pivots @ expressions,
        "skin_weights": flame.weights[:, slots],
        "pose_basis": correctives,
    }
    return Subject(
        rig_name=name,
        expression_names=tuple(f"expr{i:02d}" for i in range(len(expressions))),
        joint_drivers=tuple(driver for _, driver in JOINTS.values()),
        **{key: np.ascontiguousarray(value, np.float32) for key, value in arrays.items()},
    )


def person(flame: FlameModel, shape: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """float64[V, 3] m: the template of identity `shape` [300] with an offset [V, 3] m of each vertex."""
    return flame.template + flame.shapedirs[:, :, :N_FILE_IDENTITY] @ shape + offset


def head_motion(
    flame: FlameModel,
    neutral: np.ndarray,
    *,
    expr: np.ndarray,
    rotation: np.ndarray,
    neck_pose: np.ndarray,
    translation: np.ndarray,
) -> HeadMotion:
    """Where root and neck carry the head. Joints move with the expression.

    Args:
        neutral: See `head_subject`.
        expr: [T, 100].
        rotation, neck_pose: [T, 3] axis-angle, rad.
        translation: [T, 3] m.
    """
    regressor = flame.joint_regressor[[ROOT, NECK]]
    joints = regressor @ neutral + np.einsum("te,ejc->tjc", expr, regressor @ _expressions(flame))
    root, neck = axis_angle_to_rotmat(rotation), axis_angle_to_rotmat(neck_pose)
    arm = joints[:, NECK] - _turned(neck, joints[:, NECK]) - joints[:, ROOT]
    return HeadMotion(root @ neck, _turned(root, arm) + joints[:, ROOT] + translation)


def mean_pose(motion: HeadMotion) -> tuple[np.ndarray, np.ndarray]:
    """The rotation [3, 3] nearest to all of a motion's, and its mean translation [3]."""
    u, _, v = np.linalg.svd(motion.rotations.mean(0))
    handed = np.diag([1, 1, np.sign(np.linalg.det(u @ v))])
    return u @ handed @ v, motion.translations.mean(0)


def relative_to(pose: tuple[np.ndarray, np.ndarray], motion: HeadMotion) -> tuple[np.ndarray, np.ndarray]:
    """float32 rot [T, 3] rad and tra [T, 3] m of a motion in a world in which `pose` is none."""
    rotation, translation = pose
    rot = rotmat_to_axis_angle(rotation.T @ motion.rotations)
    tra = (motion.translations - translation) @ rotation
    return rot.astype(np.float32), tra.astype(np.float32)


def _expressions(flame: FlameModel) -> np.ndarray:
    """[100, V, 3]"""
    basis = flame.shapedirs[:, :, N_FILE_IDENTITY : N_FILE_IDENTITY + N_EXPRESSIONS]
    return basis.transpose(2, 0, 1)


def _turned(rotations: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[T, 3, 3], [T, 3] -> [T, 3]"""
    return np.einsum("tij,tj->ti", rotations, points)
