"""A face of 478 landmarks whose expressions and pose are known, and a camera that sees it."""

from __future__ import annotations

import numpy as np

from cap4d.drive.face_solver import FOCAL, IRISES, project
from cap4d.drive.landmark_head import LandmarkHead
from cap4d.rig.head import Subject
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.track.landmark_sets import BROWS, INNER_LIPS, LEFT_LIDS, OUTER_LIPS, OVAL, RIGHT_LIDS

NAMES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft", "mouthPucker", "browInnerUp")
EYES = np.array([[-0.032, 0.03, 0.05], [0.032, 0.03, 0.05]])  # right, left
LID, LIPS = 0.005, 0.0004  # m, half of what they are open at rest
MOUTH = np.array([0, -0.045, 0.08])
SIZE = 480
RADIUS = 0.0125  # m, of an eyeball


def landmark_head(*, signed: bool = False) -> LandmarkHead:
    """The avatar's."""
    rest, motion = _rest(), _motion()
    subject = Subject(
        rig_name="synthetic",
        expression_names=NAMES,
        neutral=rest.astype(np.float32),
        expression_basis=motion.astype(np.float32),
        joint_drivers=("neck", "eyes", "eyes"),
        joints=np.float32([[0, -0.1, 0], *EYES]),
        joints_expression=np.zeros((len(NAMES), 3, 3), np.float32),
        skin_weights=np.zeros((478, 3), np.float32),
    )
    limits = np.tile(np.float32([[-2 if signed else 0, 2 if signed else 1]]), (len(NAMES), 1))
    return LandmarkHead(subject, np.ones(478, bool), limits, EYES.astype(np.float32))


def seen(
    expr: dict[str, float] | None = None,
    *,
    rot: tuple[float, float, float] = (0, 0, 0),
    tra: tuple[float, float, float] = (0, 0, -0.5),
    gaze: tuple[float, float] = (0, 0),
    identity: np.ndarray | float = 0,
    lids: float = 1.0,
) -> np.ndarray:
    """float64[478, 2] px of a square picture of 480.

    Args:
        rot, tra: The head's pose before the camera, rig axes.
        gaze: Pitch and yaw, rad.
        identity: [478, 3] m added to the face at rest.
        lids: How far they are open at rest, against the avatar's.
    """
    points = _rest(lids) + identity
    for name, value in (expr or {}).items():
        points = points + value * _motion(lids)[NAMES.index(name)]
    points[list(IRISES)] += RADIUS * np.array([gaze[1], -gaze[0], 0])
    world = points @ axis_angle_to_rotmat(np.array(rot, float)).T + tra
    return project(world)[0] * FOCAL * SIZE + SIZE / 2


def _rest(lids: float = 1.0) -> np.ndarray:
    """[478, 3] m"""
    rng = np.random.default_rng(5)
    radius, angle = np.sqrt(rng.uniform(0, 1, 478)), rng.uniform(0, 2 * np.pi, 478)
    around = np.linspace(0, 2 * np.pi, len(OVAL), endpoint=False)
    radius[list(OVAL)], angle[list(OVAL)] = 1, np.pi / 2 - around
    points = np.stack([0.07 * radius * np.cos(angle), 0.095 * radius * np.sin(angle), 0 * radius], -1)
    points[:, 2] = 0.09 - 0.06 * radius**2
    for centre, ring, side in ((EYES[0], RIGHT_LIDS, 1), (EYES[1], LEFT_LIDS, -1)):
        points[list(ring)] = centre + _ring(16, 0.014 * side, lids * LID) + [0, 0, 0.012]
    for ring, width, height in ((OUTER_LIPS, 0.025, 0.008), (INNER_LIPS, 0.023, LIPS)):
        points[list(ring)] = MOUTH + _ring(20, width, height)
    points[list(BROWS), 1] = 0.05
    points[list(IRISES)] = EYES + [0, 0, RADIUS]
    return points


def _ring(count: int, width: float, height: float) -> np.ndarray:
    """[count, 3] from the corner at -width along the lower rim to the other corner and back above."""
    angle = np.pi + np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([width * np.cos(angle), height * np.sin(angle), 0 * angle], -1)


def _motion(lids: float = 1.0) -> np.ndarray:
    """[E, 478, 3] m"""
    rest = _rest()
    motion = np.zeros((len(NAMES), 478, 3))
    lower = (rest[:, 1] < MOUTH[1] - 1e-6) & (np.arange(478) < 468)
    motion[0, lower] = [0, -0.03, -0.005]
    for row, ring in ((1, LEFT_LIDS), (2, RIGHT_LIDS)):
        upper = np.array(ring)[9:]
        motion[row, upper, 1] = 2 * lids * (EYES[0, 1] - rest[upper, 1])
    near = np.exp(-(((rest - MOUTH - [0.02, 0, 0]) / 0.025) ** 2).sum(-1))
    motion[3] = near[:, None] * [0.012, 0.009, 0]
    mouth = np.exp(-(((rest - MOUTH) / 0.03) ** 2)[:, :2].sum(-1))
    motion[4] = -0.5 * mouth[:, None] * (rest - MOUTH) * [1, 0, 0]
    motion[5, list(BROWS)] = [0, 0.012, 0]
    motion[:, 468:] = 0
    return motion
