"""Albedo of every part, sRGB in [0, 1] per vertex."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.rig.builtin.field import EYE
from cap4d.rig.builtin.parts import IRIS, PUPIL
from cap4d.rig.builtin.sheet import Part, smoothstep
from cap4d.rig.builtin.skin import CORNER_COLUMN, OUTER_COLUMN, row_of

SKIN = (0.905, 0.715, 0.605)
BLUSH = (0.90, 0.56, 0.49)
LIPS = (0.80, 0.46, 0.44)
HAIR = (0.30, 0.19, 0.125)
BROW = (0.27, 0.175, 0.12)
LINING = (0.42, 0.13, 0.13)
IRIS_OUTER, IRIS_INNER = (0.20, 0.33, 0.40), (0.42, 0.56, 0.55)
SHIRT, COLLAR = (0.23, 0.39, 0.47), (0.19, 0.33, 0.41)


def _blend(colors: np.ndarray, over: tuple, share: np.ndarray) -> np.ndarray:
    return colors + share[:, None] * (np.array(over) - colors)


def _spot(p: np.ndarray, centre: tuple, size: tuple) -> np.ndarray:
    """1 at `centre` (x, y) falling off as a Gaussian of half widths `size`, in front of the ears only."""
    return np.exp(-(((p[:, :2] - centre) / size) ** 2).sum(1)) * (p[:, 2] > 15)


def brow_share(p: np.ndarray) -> np.ndarray:
    """[N] how much of a point is eyebrow: a band that arches from over the inner corner to the temple and
    tapers.
    """
    x = np.abs(p[:, 0])
    t = np.clip((x - 13.0) / 39, 0, 1)
    middle = 38.6 + 6.6 * np.sin(np.pi * np.clip(t * 0.92, 0, 1) ** 1.2) - 3.0 * t
    half = 3.4 * (1 - 0.75 * t**1.5) * smoothstep(-0.06, 0.16, (x - 13.0) / 39)
    across = smoothstep(half + 1.6, half - 1.8, np.abs(p[:, 1] - middle))
    return across * smoothstep(11.0, 16.5, x) * smoothstep(54, 45, x) * (p[:, 2] > 30)


def paint_skin(part: Part) -> Part:
    p, row, column, depth = part.points, part.marks["row"], part.marks["column"], part.marks["depth"]
    c = np.tile(np.array(SKIN), (len(p), 1))
    blush = (
        0.42 * _spot(p, (40, -20), (17, 14))
        + 0.38 * _spot(p, (0, -17), (13, 9))
        + 0.15 * _spot(p, (0, -88), (16, 10))
    )
    c = _blend(c, BLUSH, blush)
    c = _blend(
        c, (0.80, 0.56, 0.50), 0.35 * _spot(p, tuple(EYE[:2]), (19, 12))
    )  # thinner skin about the eyes
    c = _blend(c, (0.35, 0.13, 0.11), 0.9 * _spot(p, (5.6, -29.0), (3.0, 2.0)) * (p[:, 2] > 80))  # nostrils
    top, bottom = row_of("upper_vermilion"), row_of("lower_vermilion")
    upper, lower = row_of("upper_lip"), row_of("lower_lip")
    reach = smoothstep(CORNER_COLUMN + 0.6, CORNER_COLUMN - 1.5, column)
    edge = np.minimum(smoothstep(top - 0.6, top + 1.2, row), smoothstep(bottom + 0.6, bottom - 1.2, row))
    c = _blend(c, LIPS, 0.92 * edge * reach)
    seam = np.maximum(
        smoothstep(upper - 2, upper, row) * (row <= upper), smoothstep(lower + 2, lower, row) * (row >= lower)
    )
    in_mouth = (column <= CORNER_COLUMN) * 1.0
    c = _blend(
        c,
        (0.55, 0.25, 0.25),
        0.55 * seam * in_mouth * smoothstep(CORNER_COLUMN + 0.5, CORNER_COLUMN - 3, column),
    )
    lip_inside = (depth > 0) & (row >= upper)
    c = _blend(c, LINING, np.where(lip_inside, np.clip(0.25 * depth, 0, 1), 0))
    eye_top, eye_bottom = row_of("upper_lid"), row_of("lower_lid")
    in_eye = ((column >= CORNER_COLUMN) & (column <= OUTER_COLUMN)) * 1.0
    c = _blend(
        c, (0.72, 0.42, 0.38), 0.55 * in_eye * ((row == eye_bottom) | (row == eye_top)) * (depth >= 1)
    )  # the wet rims
    lash = in_eye * (row == eye_top) * np.where(depth == 0, 1.0, np.where(depth == 1, 0.5, 0.0))
    c = _blend(
        c, (0.13, 0.09, 0.08), 0.92 * lash * smoothstep(CORNER_COLUMN - 0.5, CORNER_COLUMN + 4, column)
    )
    c = _blend(c, (0.62, 0.40, 0.34), 0.35 * in_eye * (row == eye_bottom) * (depth == 0))
    c = _blend(c, BROW, 0.93 * brow_share(p) * (depth == 0))
    shadow = smoothstep(row_of("jaw") - 2, row_of("throat"), row) * smoothstep(110, 60, column * 2.0)
    c = c * (1 - 0.10 * shadow[:, None])
    return replace(part, colors=c)


def paint_eye(part: Part) -> Part:
    a, turn = part.marks["angle"], part.marks["turn"]
    c = np.tile([0.95, 0.94, 0.925], (len(a), 1))
    c = _blend(c, (0.90, 0.70, 0.66), smoothstep(0.75, 1.4, a))
    c = _blend(c, IRIS_OUTER, smoothstep(IRIS + 0.02, IRIS, a))
    fibres = 0.5 + 0.5 * np.sin(10 * turn) * np.sin(23 * turn + 1)
    c = _blend(c, IRIS_INNER, smoothstep(IRIS - 0.03, PUPIL + 0.07, a) * (0.65 + 0.35 * fibres))
    c = _blend(
        c, (0.09, 0.13, 0.16), smoothstep(IRIS - 0.06, IRIS, a) * smoothstep(IRIS + 0.05, IRIS, a) * 0.7
    )
    return replace(part, colors=_blend(c, (0.02, 0.02, 0.025), smoothstep(PUPIL + 0.008, PUPIL - 0.012, a)))


def paint_teeth(part: Part) -> Part:
    share, gap = part.marks["enamel"], part.marks["gap"]
    c = np.tile([0.965, 0.945, 0.905], (len(share), 1))
    c = _blend(c, (0.62, 0.50, 0.42), 0.55 * np.clip(1 - gap, 0, 1))
    return replace(
        part, colors=_blend(c, (0.80, 0.45, 0.44), smoothstep(0.10, 0.02, share + 0.1 * (gap - 1)))
    )


def paint_tongue(part: Part) -> Part:
    p = part.points
    c = np.tile([0.80, 0.43, 0.42], (len(p), 1))
    return replace(part, colors=_blend(c, (0.62, 0.28, 0.29), np.exp(-((p[:, 0] / 1.6) ** 2)) * 0.6))


def paint_mouth(part: Part) -> Part:
    deep = smoothstep(75, 45, part.points[:, 2])
    return replace(part, colors=_blend(np.tile(LINING, (len(deep), 1)), (0.14, 0.04, 0.045), deep))


def paint_ear(part: Part) -> Part:
    c = np.tile(np.array(SKIN), (len(part.points), 1))
    hollow = smoothstep(1.0, -5.5, part.marks["height"]) * (part.marks["behind"] < 0.5)
    c = _blend(c, (0.80, 0.52, 0.45), 0.55 * hollow)
    return replace(part, colors=_blend(c, BLUSH, 0.28 * smoothstep(0.75, 1.0, part.marks["rho"])))


def paint_hair(part: Part) -> Part:
    lock = part.marks["lock"]
    c = np.array(HAIR) * (0.82 + 0.55 * lock[:, None] ** 1.5)
    return replace(part, colors=c * (1 - 0.25 * smoothstep(0.93, 1.0, part.marks["share"]))[:, None])


def paint_shirt(part: Part) -> Part:
    return replace(part, colors=_blend(np.tile(SHIRT, (len(part.points), 1)), COLLAR, part.marks["band"]))


BRUSHES = {
    "skin": paint_skin,
    "mouth": paint_mouth,
    "eye": paint_eye,
    "teeth_upper": paint_teeth,
    "teeth_lower": paint_teeth,
    "tongue": paint_tongue,
    "ear": paint_ear,
    "hair": paint_hair,
    "shirt": paint_shirt,
}


def paint(part: Part) -> Part:
    """The part with its colours, on both halves."""
    painted = BRUSHES[part.name](part)
    return painted if part.other is None else replace(painted, other=paint(part.other))
