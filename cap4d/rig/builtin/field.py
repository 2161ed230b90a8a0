"""The head's form as one smooth implicit surface: round solids melted into each other, the way a sculptor
adds clay.

Everything is in millimetres in the rig's axes and symmetric in x. Only the broad form lives here; lips, lids,
ears and hair are laid on later (skin.py, parts.py). The melting is the polynomial smooth minimum (Quilez
2013).
"""

from __future__ import annotations

import numpy as np

EYE = np.array([33.0, 20.0, 59.5])  # centre of the left eyeball
EYE_RADIUS = 15.5
LID_RADIUS = 17.4  # the outer surface of the lids, a sphere about the same centre


def ellipsoid(p: np.ndarray, centre: tuple, radii: tuple) -> np.ndarray:
    """[N] approximate distance of p [N, 3] to an ellipsoid, exact on its surface to first order."""
    q = (p - np.array(centre)) / np.array(radii)
    squares = q * q
    near = np.sqrt(squares @ np.ones(3)) + 1e-9
    slope = np.sqrt(squares @ (1.0 / np.square(radii))) + 1e-9
    return near * (near - 1) / slope


def bone(p: np.ndarray, a: tuple, b: tuple, radius_a: float, radius_b: float) -> np.ndarray:
    """[N] distance to a capsule from a to b whose radius changes linearly."""
    a, axis = np.array(a, float), np.array(b, float) - np.array(a, float)
    along = np.clip((p - a) @ axis / (axis @ axis), 0, 1)
    off = p - a - along[:, None] * axis
    return np.sqrt((off * off) @ np.ones(3)) - (radius_a + (radius_b - radius_a) * along)


def melt(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Union of two solids with a fillet of about `width`."""
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - overlap * overlap * width / 4


def carve(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Solid a without b, with a rounded edge."""
    return -melt(-a, b, width)


def head_distance(points: np.ndarray) -> np.ndarray:
    """[N] signed distance (mm, negative inside) of points [N, 3] to the bare head and neck."""
    p = points * 1.0
    p[:, 0] = np.sqrt(p[:, 0] ** 2 + 9)  # |x| without a crease along the midline
    d = ellipsoid(p, (0, 40, -12), (73, 84, 93))  # cranium
    d = melt(d, ellipsoid(p, (0, 52, 22), (60, 50, 64)), 30)  # forehead
    d = melt(d, ellipsoid(p, (0, -16, 16), (60, 68, 61)), 34)  # midface
    d = melt(d, ellipsoid(p, (42, -8, 42), (22, 20, 24)), 34)  # cheekbone
    d = melt(d, ellipsoid(p, (30, -32, 54), (24, 24, 20)), 30)  # cheek
    d = melt(d, bone(p, (42, -48, 0), (16, -83, 54), 14, 14), 34)  # jaw
    d = melt(d, ellipsoid(p, (0, -54, 52), (34, 30, 35)), 26)  # jaws behind the lips
    d = melt(d, ellipsoid(p, (0, -86, 66), (18, 15, 17)), 22)  # chin
    d = melt(d, bone(p, (12, 41, 74), (44, 38, 56), 8, 7), 22)  # brow ridge
    d = carve(d, ellipsoid(p, (34, 19, 85), (21, 13, 13)), 18)  # eye socket
    d = melt(d, ellipsoid(p, tuple(EYE), (LID_RADIUS,) * 3), 6)  # lids
    d = melt(d, nose_distance(p), 10)
    d = melt(d, bone(p, (0, -10, -30), (0, -230, -44), 44, 53), 30)  # neck
    return melt(
        d, bone(p, (50, -56, -22), (15, -170, 2), 7, 6), 18
    )  # the muscle from behind the ear to the throat


def nose_distance(p: np.ndarray) -> np.ndarray:
    """[N] distance to the nose: bridge, tip, wings and the column between the nostrils."""
    d = bone(p, (0, 24, 77), (0, -12, 97), 7, 8)
    d = melt(d, ellipsoid(p, (0, -17, 100), (10, 9.5, 9.5)), 10)
    d = melt(d, ellipsoid(p, (11.8, -22.5, 89), (6.8, 6.4, 9.5)), 7)
    return melt(d, bone(p, (0, -22, 98), (0, -31, 86), 4, 5), 7)


def cast(origins: np.ndarray, directions: np.ndarray, start: float = 150.0, steps: int = 24) -> np.ndarray:
    """[N, 3] the outermost surface points on rays, found by sphere tracing from `start` mm back to the
    origin.
    """
    reach = np.full(len(origins), start)
    for _ in range(steps):
        reach -= 0.95 * head_distance(origins + reach[:, None] * directions)
    return settle(origins + np.maximum(reach, 0)[:, None] * directions, 2)


def settle(points: np.ndarray, steps: int = 4) -> np.ndarray:
    """[N, 3] points moved onto the surface along its normal (Newton)."""
    h = 0.05
    for _ in range(steps):
        value = head_distance(points)
        gradient = np.stack([head_distance(points + h * e) - value for e in np.eye(3)], -1) / h
        points = points - (value / np.maximum((gradient**2).sum(-1), 0.05))[:, None] * gradient
    return points
