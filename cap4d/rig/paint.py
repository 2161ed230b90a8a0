"""Plain colours for heads, so that pictures of a rig look like a face (and a face detector agrees)."""

from __future__ import annotations

import numpy as np

SKIN = (0.80, 0.61, 0.52)
LIPS = (0.71, 0.38, 0.37)
BROWS = (0.27, 0.19, 0.15)
HAIR = (0.23, 0.17, 0.14)
LASHES = (0.24, 0.17, 0.15)
SCLERA = (0.93, 0.92, 0.91)
IRIS = (0.36, 0.24, 0.16)
PUPIL = (0.04, 0.04, 0.04)
TEETH = (0.92, 0.90, 0.85)
GUMS = (0.72, 0.40, 0.40)
CAVITY = (0.36, 0.16, 0.15)
SHIRT = (0.30, 0.36, 0.45)

PUPIL_ANGLE, IRIS_ANGLE = 9.0, 21.5  # degrees from the gaze direction
BROW_HALF_WIDTH = 0.0042  # m
LASH_HALF_WIDTH = 0.0011  # m


def soft_step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smooth 0 to 1 as x goes from low to high."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def blend(colors: np.ndarray, weight: np.ndarray, paint: tuple[float, float, float]) -> None:
    """Lays `paint` over [V, 3] colours in place, as opaque as `weight` [V]."""
    colors += weight[:, None] * (np.array(paint) - colors)


def distance_to_line(points: np.ndarray, line: np.ndarray, *, closed: bool = False) -> np.ndarray:
    """[V] m from each point to the polyline `line` [P, 3]."""
    ends = np.roll(line, -1, 0) if closed else line[1:]
    nearest = np.full(len(points), np.inf)
    for a, b in zip(line, ends, strict=False):
        t = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - t[:, None] * (b - a), axis=1))
    return nearest


def inside_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """bool[V] by crossing number, in the plane."""
    inside = np.zeros(len(points), bool)
    for a, b in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        crosses = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
        rise = np.where(b[1] == a[1], 1, b[1] - a[1])
        inside ^= crosses & (points[:, 0] < a[0] + (points[:, 1] - a[1]) / rise * (b[0] - a[0]))
    return inside


def paint_face(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """[V, 3] colours of skin, lips, brows, lash lines and short hair.

    Args:
        points: [V, 3] m, rig axes, the skin.
        landmarks: [68, 3] Multi-PIE landmarks on it.
    """
    colors = np.tile(np.array(SKIN), (len(points), 1))
    lips = inside_polygon(points[:, :2], landmarks[48:60, :2]) & (points[:, 2] > landmarks[48, 2] - 0.01)
    blend(colors, lips.astype(float), LIPS)
    for brow in (landmarks[17:22], landmarks[22:27]):
        near = distance_to_line(points, brow)
        blend(colors, 0.9 * (1 - soft_step(near, 0.6 * BROW_HALF_WIDTH, 1.3 * BROW_HALF_WIDTH)), BROWS)
    for eye in (landmarks[36:42], landmarks[42:48]):
        near = distance_to_line(points, eye, closed=True)
        blend(colors, 0.8 * (1 - soft_step(near, LASH_HALF_WIDTH, 2 * LASH_HALF_WIDTH)), LASHES)
    blend(colors, _hair(points, landmarks), HAIR)
    return colors


def _hair(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """How much hair: above a hairline that runs from the forehead down in front of the ears to the nape."""
    brow = landmarks[17:27].mean(0)
    temple, ear = landmarks[0], landmarks[1]
    z = [ear[2] - 0.12, ear[2] - 0.06, ear[2] - 0.02, temple[2] + 0.01, brow[2] - 0.025, brow[2]]
    y = [
        temple[1] - 0.055,
        temple[1] - 0.045,
        temple[1] - 0.005,
        temple[1] + 0.02,
        brow[1] + 0.045,
        brow[1] + 0.055,
    ]
    line = np.interp(points[:, 2], z, y)
    return 0.95 * soft_step(points[:, 1] - line, -0.003, 0.003)


def paint_eye(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """[V, 3] colours of an eyeball that looks along +z."""
    arm = points - centre
    angle = np.degrees(np.arccos(np.clip(arm[:, 2] / np.linalg.norm(arm, axis=1), -1, 1)))
    colors = np.tile(np.array(SCLERA), (len(points), 1))
    blend(colors, 1 - soft_step(angle, IRIS_ANGLE - 1, IRIS_ANGLE + 1), IRIS)
    blend(colors, 1 - soft_step(angle, PUPIL_ANGLE - 1, PUPIL_ANGLE + 1), PUPIL)
    return colors
