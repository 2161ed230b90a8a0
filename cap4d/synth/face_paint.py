"""Procedural skin, lips, brows, stubble, eyes, teeth and cloth over the texels of an atlas: one texture.

Everything is evaluated on the template in metres, with noise in space, so there are no seams. The face's
features are found by the 68 landmarks where the rig has them, by the rig's own colours elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cap4d import _core
from cap4d.rig import paint
from cap4d.rig.head import HeadRig
from cap4d.synth.atlas import KINDS, Atlas
from cap4d.synth.complexion import Complexion

MM = 1e-3
LIP, LIP_INSIDE, NOSE_TIP, NOSE_BASE, CHIN = slice(48, 60), slice(60, 68), 30, 33, 8
BROWS, EYES = (slice(17, 22), slice(22, 27)), (slice(36, 42), slice(42, 48))
CAVITY = np.array([0.16, 0.045, 0.04])  # linear RGB of the inside of a mouth
MOLARS = (
    0.010,
    0.026,
)  # m behind the incisors: over this way teeth fade into the mouth's dark, as cheeks hide them
PUPIL_DEG, IRIS_DEG = 8.5, 25.0  # from the gaze's direction, seen from the ball's centre


@dataclass(frozen=True, eq=False)
class Paint:
    """What is laid on N texels: albedo [N, 3] linear, specular, roughness, scattering and height (m) [N]."""

    albedo: np.ndarray
    specular: np.ndarray
    roughness: np.ndarray
    scattering: np.ndarray
    height: np.ndarray


def paint_texture(rig: HeadRig, atlas: Atlas, look: Complexion, scalp: np.ndarray) -> np.ndarray:
    """float32[S, S, 8] as `light_surface` reads it: albedo, specular, roughness, scattering, slopes.

    Args:
        scalp: [V] how densely hair grows at each vertex.
    """
    look = replace(look, scalp=scalp)
    layers = np.zeros((len(atlas.points), 7), np.float32)
    for kind in KINDS:
        texels = atlas.of(kind)
        if len(texels):
            laid = PAINTERS[kind](rig, atlas, texels, look)
            columns = (laid.specular, laid.roughness, laid.scattering, laid.height)
            layers[texels] = np.column_stack([laid.albedo, *columns])
    image = atlas.spread(layers)
    down, right = np.gradient(image[..., 6])
    return np.ascontiguousarray(np.concatenate([image[..., :6], right[..., None], down[..., None]], -1))


def noise(points: np.ndarray, wavelength: float, seed: int, octaves: int = 1) -> np.ndarray:
    """[N] in about [-1, 1], of features of `wavelength` m; each octave is half as long and as strong."""
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        scaled = np.ascontiguousarray(points * (2**octave / wavelength), np.float32)
        total += _core.gradient_noise(scaled, (seed + 101 * octave) % 2**32) * 0.5**octave
    return total


def spots(points: np.ndarray, spacing: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """[N] m to the nearest of points strewn `spacing` m apart, and a number in [0, 1) of that one's own."""
    distance, own = _core.cellular_noise(np.ascontiguousarray(points / spacing, np.float32), seed % 2**32)
    return distance * spacing, own


def near(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """[N] 1 at `centre`, fading over `radius` m."""
    return np.exp(-(((points - centre) / radius) ** 2).sum(1))


def _skin(rig: HeadRig, atlas: Atlas, texels: np.ndarray, look: Complexion) -> Paint:
    p, marks = atlas.points[texels], _landmarks(rig)
    melanin, blood = _pigments(rig, p, marks, look)
    lips = _lips(rig, p, atlas.old[texels], marks)
    scalp = np.clip(atlas.of_vertices(look.scalp, texels), 0, 1)
    bare = _bare_skin(p, marks, look, look.skin(melanin, blood))
    tint = look.skin(melanin * 0.6, blood + 0.75 + 1.2 * look.lip) * look.lip_tint
    return _with_hair(_with_lips(bare, p, look, lips, tint), rig, p, marks, look, lips, scalp)


def _pigments(
    rig: HeadRig, p: np.ndarray, marks: np.ndarray | None, look: Complexion
) -> tuple[np.ndarray, np.ndarray]:
    """[N] and [N] amounts of melanin and haemoglobin."""
    seed = look.seed
    melanin = look.melanin * (1 + 0.10 * noise(p, 0.035, seed + 1, 3) + 0.06 * noise(p, 0.004, seed + 2, 2))
    blood = look.haemoglobin * (1 + 0.22 * noise(p, 0.018, seed + 3, 3) + 0.12 * noise(p, 0.003, seed + 4, 2))
    blood = blood + look.blush * 0.45 * _flush(p, marks)
    melanin = melanin + look.freckles * _freckles(p, marks, seed) + look.moles * _moles(p, seed)
    socket = _around_eyes(p, rig)
    return melanin + 0.12 * socket * (0.5 + look.melanin), blood + 0.22 * socket


def _bare_skin(p: np.ndarray, marks: np.ndarray | None, look: Complexion, albedo: np.ndarray) -> Paint:
    shine = 0.40 + 0.22 * _oily(p, marks) + 0.10 * noise(p, 0.006, look.seed + 5, 2)
    pores, _ = spots(p, 1.1 * MM, look.seed + 6)
    height = 0.06 * MM * np.minimum(pores / MM, 0.6) + 0.05 * MM * noise(p, 1.8 * MM, look.seed + 7, 2)
    return Paint(albedo, shine, 0.52 - 0.07 * _oily(p, marks), np.ones(len(p), np.float32), height)


def _with_lips(skin: Paint, p: np.ndarray, look: Complexion, lips: np.ndarray, tint: np.ndarray) -> Paint:
    """Skin that is as much vermilion as `lips` [N] say, of colour `tint` [N, 3]."""
    mix = lips * (0.55 + 0.35 * look.lip)
    folds = noise(p * [1.0, 0.22, 0.22], 1.5 * MM, look.seed + 8, 2)
    creased = (1 - 0.10 * lips * np.maximum(folds, 0))[:, None]
    return replace(
        skin,
        albedo=(skin.albedo + mix[:, None] * (tint - skin.albedo)) * creased,
        specular=skin.specular + 0.15 * lips,
        roughness=skin.roughness - 0.12 * lips,
        height=skin.height * (1 - lips) + lips * 0.16 * MM * folds,
    )


def _with_hair(
    skin: Paint,
    rig: HeadRig,
    p: np.ndarray,
    marks: np.ndarray | None,
    look: Complexion,
    lips: np.ndarray,
    scalp: np.ndarray,
) -> Paint:
    """Skin with what strands do not draw: stubble, the ground of brows, lashes and hair (`scalp` [N])."""
    seed, albedo = look.seed, skin.albedo.copy()
    beard = _stubble(p, marks, seed) * look.stubble * (1 - lips)
    albedo += beard[:, None] * (look.hair * 0.8 + 0.15 * albedo - albedo)
    brows = 0.5 * _brows(rig, p, marks, seed) * look.brow
    albedo += brows[:, None] * (look.hair * 0.75 + 0.02 - albedo)
    lash = _lash_line(rig, p, marks)
    albedo += (0.75 * lash)[:, None] * (look.hair * 0.5 + 0.01 - albedo)
    hair = paint.soft_step(scalp + 0.15 * noise(p, 2.5 * MM, seed + 18, 2), 0.25, 0.85)
    strands = 1 + 0.5 * noise(p * [1, 0.35, 0.35], 1.2 * MM, seed + 9, 2)
    albedo += (0.92 * hair)[:, None] * (look.hair * strands[:, None] + 0.03 * albedo - albedo)
    covered = np.clip(hair + brows + beard, 0, 1)
    return Paint(
        np.clip(albedo, 0.002, 0.95),
        skin.specular * (1 - 0.6 * covered),
        skin.roughness + 0.08 * covered,
        skin.scattering * (1 - 0.9 * covered),
        skin.height + hair * 0.25 * MM * noise(p, 1.5 * MM, seed + 10, 2),
    )


def _landmarks(rig: HeadRig) -> np.ndarray | None:
    """[68, 3] on the template, m, where the rig has them."""
    ids = rig.regions.get("landmarks")
    return None if ids is None or len(ids) != 68 else rig.template[ids].astype(np.float64)


def eye_balls(rig: HeadRig) -> list[tuple[np.ndarray, float]]:
    """Centre and radius (m) of each eyeball, by its joint; none where no joint turns eyes."""
    balls = []
    for joint, driver in enumerate(rig.joint_drivers):
        turned = rig.skin_weights[:, joint] > 0.5
        if driver == "eyes" and turned.any():
            centre = rig.joints[joint].astype(np.float64)
            balls.append((centre, float(np.median(np.linalg.norm(rig.template[turned] - centre, axis=1)))))
    return balls


def _flush(p: np.ndarray, marks: np.ndarray | None) -> np.ndarray:
    """[N] where blood shows: cheeks, nose, chin, ears."""
    if marks is None:
        return 0.3 + np.zeros(len(p))
    cheeks = [
        0.55 * marks[eye].mean(0) + 0.45 * marks[corner] for eye, corner in zip(EYES, (48, 54), strict=True)
    ]
    total = sum(near(p, c + [np.sign(c[0]) * 0.012, -0.004, 0], 0.022) for c in cheeks)
    total = total + 0.9 * near(p, marks[NOSE_TIP], 0.015) + 0.4 * near(p, marks[CHIN], 0.02)
    ears = paint.soft_step(np.abs(p[:, 0]), np.abs(marks[0, 0]) - 0.001, np.abs(marks[0, 0]) + 0.012)
    return total + 0.8 * ears * (p[:, 2] < marks[0, 2] + 0.02) * (p[:, 1] > marks[4, 1])


def _oily(p: np.ndarray, marks: np.ndarray | None) -> np.ndarray:
    """[N] forehead and nose shine more."""
    if marks is None:
        return np.zeros(len(p))
    brow = marks[17:27].mean(0)
    return near(p, marks[NOSE_TIP], 0.02) + 0.7 * near(p, brow + [0, 0.03, 0], 0.035)


def _freckles(p: np.ndarray, marks: np.ndarray | None, seed: int) -> np.ndarray:
    distance, own = spots(p, 3.2 * MM, seed + 11)
    radius = (0.35 + 0.9 * own**2) * MM
    where = 0.35 if marks is None else 0.12 + sum(near(p, marks[i], 0.04) for i in (31, 35, 28))
    kept = np.mod(own * 7.31, 1) < 0.75
    return 0.85 * (1 - paint.soft_step(distance, 0.4 * radius, 1.3 * radius)) * kept * np.clip(where, 0, 1)


def _moles(p: np.ndarray, seed: int) -> np.ndarray:
    distance, own = spots(p, 34 * MM, seed + 12)
    radius = (0.5 + 1.1 * own) * MM
    return 1.7 * (1 - paint.soft_step(distance, 0.6 * radius, 1.2 * radius))


def _around_eyes(p: np.ndarray, rig: HeadRig) -> np.ndarray:
    return sum(
        (
            np.exp(-((np.maximum(np.linalg.norm(p - c, axis=1) - r, 0) / 0.006) ** 2))
            for c, r in eye_balls(rig)
        ),
        np.zeros(len(p)),
    )


def _curve(points: np.ndarray, *, closed: bool, per: int = 6) -> np.ndarray:
    """A Catmull-Rom curve through [N, D] points."""
    n = len(points)
    at = np.arange(0, n if closed else n - 1, 1 / per)
    i, t = at.astype(int), (at % 1)[:, None]
    pick = (lambda k: points[(i + k) % n]) if closed else (lambda k: points[np.clip(i + k, 0, n - 1)])
    a, b, c, d = pick(-1), pick(0), pick(1), pick(2)
    curve = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    return curve if closed else np.concatenate([curve, points[-1:]])


def _lips(rig: HeadRig, p: np.ndarray, old: np.ndarray, marks: np.ndarray | None) -> np.ndarray:
    """[N] how much vermilion."""
    if marks is None:
        redness = (old[:, 0] - old[:, 1]) - (paint.SKIN[0] - paint.SKIN[1])
        lips = paint.soft_step(redness, 0.05, 0.13)
        return lips * (p[:, 1] < 0) * (p[:, 2] > np.quantile(rig.template[:, 2], 0.9))
    outline = _curve(marks[LIP, :2], closed=True)
    low, high = outline.min(0) - 0.004, outline.max(0) + 0.004
    box = ((p[:, :2] > low) & (p[:, :2] < high)).all(1) & (p[:, 2] > marks[48, 2] - 0.012)
    q = p[box, :2]
    signed = paint.distance_to_line(q, outline, closed=True) * np.where(
        paint.inside_polygon(q, outline), 1, -1
    )
    lips = np.zeros(len(p))
    lips[box] = paint.soft_step(signed, -0.9 * MM, 0.9 * MM)
    return lips


def _brows(rig: HeadRig, p: np.ndarray, marks: np.ndarray | None, seed: int) -> np.ndarray:
    """[N] the ground of the brows: short strokes that lean outwards, thinning towards the tail."""
    if marks is None:
        return np.zeros(len(p))
    total = np.zeros(len(p))
    for brow in BROWS:
        line = marks[brow] if abs(marks[brow][0, 0]) < abs(marks[brow][-1, 0]) else marks[brow][::-1]
        line = _curve(line[:, :2], closed=False)
        box = (np.abs(p[:, :2] - line.mean(0)) < [0.042, 0.022]).all(1) & (p[:, 2] > marks[0, 2])
        total[box] = np.maximum(total[box], _brow(p[box], line, seed))
    return total


def _brow(p: np.ndarray, line: np.ndarray, seed: int) -> np.ndarray:
    offsets = p[:, None, :2] - line[None]
    nearest = (offsets**2).sum(-1).argmin(1)
    along = nearest / (len(line) - 1)
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    t, n = tangent[nearest], np.stack([-tangent[nearest, 1], tangent[nearest, 0]], 1)
    n *= np.sign(n[:, 1:])
    offset = offsets[np.arange(len(p)), nearest]
    across, beyond = (offset * n).sum(1), (offset * t).sum(1)
    width = 4.6 * MM * (0.75 + 0.5 * along) * (1 - 0.72 * along**2.2)
    edge = np.abs(across) / width + np.abs(beyond) / (5 * MM)
    lean = np.radians(68 - 58 * np.clip(along * 1.6, 0, 1))
    run = np.cos(lean)[:, None] * t + np.sin(lean)[:, None] * n
    side = np.sin(lean)[:, None] * t - np.cos(lean)[:, None] * n
    q = np.column_stack([(p[:, :2] * run).sum(1) * 0.16, (p[:, :2] * side).sum(1), np.zeros(len(p))])
    hairs = noise(q, 0.62 * MM, seed + 14, 2)
    density = 1 - paint.soft_step(edge, 0.45, 1.15)
    return np.clip(density * 1.5 * (0.62 + 0.85 * hairs), 0, 1) * (
        0.55 + 0.45 * paint.soft_step(along, 0, 0.2)
    )


def _lash_line(rig: HeadRig, p: np.ndarray, marks: np.ndarray | None) -> np.ndarray:
    """[N] the dark roots along the lids' rims, above more than below."""
    if marks is None:
        return np.zeros(len(p))
    total = np.zeros(len(p))
    for eye in EYES:
        rim = _curve(marks[eye], closed=True)
        box = (np.abs(p - rim.mean(0)) < [0.024, 0.016, 0.02]).all(1)
        q = p[box]
        upper = paint.soft_step(q[:, 1], rim[:, 1].mean() - 0.001, rim[:, 1].mean() + 0.001)
        distance = paint.distance_to_line(q, rim, closed=True)
        width = (0.55 + 0.75 * upper) * MM
        total[box] = (0.35 + 0.65 * upper) * (1 - paint.soft_step(distance, 0.5 * width, 1.6 * width))
    return total


def _stubble(p: np.ndarray, marks: np.ndarray | None, seed: int) -> np.ndarray:
    """[N] cut hairs over jaw, chin and upper lip."""
    if marks is None:
        return np.zeros(len(p))
    jaw = _curve(marks[:17], closed=False)
    sides = [0, abs(marks[54, 0]), abs(marks[2, 0]), abs(marks[1, 0])]
    heights = marks[[NOSE_BASE, 48, 2, 1], 1] + [-0.002, 0.008, 0.012, 0.02]
    top = np.interp(np.abs(p[:, 0]), sides, heights)
    back_to_front = jaw[np.argsort(jaw[:, 2])]
    bottom = np.interp(p[:, 2], back_to_front[:, 2], back_to_front[:, 1]) - 0.03
    blur = 4 * MM * noise(p, 0.012, seed + 15, 2)
    inside = paint.soft_step(top - p[:, 1] + blur, -0.004, 0.006) * paint.soft_step(
        p[:, 1] - bottom + blur, 0, 0.02
    )
    front = paint.soft_step(p[:, 2], marks[0, 2] - 0.004, marks[0, 2] + 0.008)
    distance, own = spots(p, 0.75 * MM, seed + 16)
    dots = 1 - paint.soft_step(distance, 0.12 * MM, (0.30 + 0.25 * own) * MM)
    under_lip = 1 - 0.6 * near(p, 0.5 * (marks[57] + marks[CHIN]) + [0.013, 0.003, 0], 0.008)
    return inside * front * under_lip * (0.28 + 0.6 * dots)


def _eye(rig: HeadRig, atlas: Atlas, texels: np.ndarray, look: Complexion) -> Paint:
    p, seed = atlas.points[texels], look.seed
    albedo = np.tile(np.array([0.66, 0.62, 0.59]), (len(p), 1))
    height = np.zeros(len(p))
    for centre, _ in eye_balls(rig) or [(p.mean(0), 0.012)]:
        mine = np.abs(p[:, 0] - centre[0]) < 0.02
        arm = p[mine] - centre
        arm /= np.linalg.norm(arm, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip(arm[:, 2], -1, 1)))
        albedo[mine] = _eyeball(arm, angle, look, seed + int(centre[0] > 0))
    flat = np.ones(len(p))
    return Paint(np.clip(albedo, 0.003, 0.9), flat, 0.17 * flat, 0.35 * flat, height)


def _eyeball(arm: np.ndarray, angle: np.ndarray, look: Complexion, seed: int) -> np.ndarray:
    veins = 1 - np.abs(noise(arm * 0.012, 0.0055, seed + 20, 3)) / 0.07
    outer = paint.soft_step(angle, IRIS_DEG + 2, 62)
    sclera = np.array([0.60, 0.565, 0.535]) - np.outer(outer, [0.10, 0.17, 0.16])
    sclera = sclera - (np.clip(veins, 0, 1) * (0.25 + outer))[:, None] * np.array([0.04, 0.16, 0.15])
    around = np.arctan2(arm[:, 1], arm[:, 0])
    ring = np.stack([np.cos(around), np.sin(around)], 1)
    fibres = noise(np.column_stack([ring, angle / 90]), 0.11, seed + 21, 3)
    r = np.clip((angle - PUPIL_DEG) / (IRIS_DEG - PUPIL_DEG), 0, 1)
    collarette = paint.soft_step(r + 0.12 * fibres, 0.18, 0.42)
    iris = look.iris_inner + collarette[:, None] * (look.iris - look.iris_inner)
    iris = iris * (1.0 + 0.75 * fibres * paint.soft_step(r, 0, 0.25))[:, None] * 1.35
    iris *= (1 - 0.75 * paint.soft_step(r, 0.72, 1.0))[:, None]  # limbal ring
    pupil = 1 - paint.soft_step(angle, PUPIL_DEG - 1, PUPIL_DEG + 1)
    iris += pupil[:, None] * (0.004 - iris)
    edge = 1 - paint.soft_step(angle, IRIS_DEG - 1.6, IRIS_DEG + 1.6)
    lid = 1 - 0.55 * paint.soft_step(arm[:, 1], 0.12, 0.42) - 0.15 * paint.soft_step(-arm[:, 1], 0.2, 0.45)
    return (sclera + edge[:, None] * (iris - sclera)) * lid[:, None]  # with the shade of lids and lashes


def _teeth(rig: HeadRig, atlas: Atlas, texels: np.ndarray, look: Complexion) -> Paint:
    p, one = atlas.points[texels], np.ones(len(texels))
    shade = 1 + 0.06 * noise(p, 0.006, look.seed + 30, 2)
    front = p[:, 2].max()
    lit = paint.soft_step(p[:, 2], front - MOLARS[1], front - MOLARS[0])
    albedo = CAVITY + lit[:, None] * (np.array([0.72, 0.66, 0.54]) * shade[:, None] - CAVITY)
    return Paint(albedo, 0.9 * lit, 0.25 * one, 0.3 * one, 0 * one)


def _gums(rig: HeadRig, atlas: Atlas, texels: np.ndarray, look: Complexion) -> Paint:
    p, one = atlas.points[texels], np.ones(len(texels))
    shade = (1 + 0.15 * noise(p, 0.004, look.seed + 31, 3)) * np.exp(-0.25 * look.melanin)
    albedo = np.array([0.44, 0.15, 0.14]) * shade[:, None]
    return Paint(albedo, 0.9 * one, 0.3 * one, one, 0.1 * MM * noise(p, 2 * MM, look.seed + 32, 2))


def _cavity(rig: HeadRig, atlas: Atlas, texels: np.ndarray, look: Complexion) -> Paint:
    one = np.ones(len(texels))
    return Paint(np.tile(CAVITY, (len(texels), 1)), 0.5 * one, 0.4 * one, one, 0 * one)


def _cloth(rig: HeadRig, atlas: Atlas, texels: np.ndarray, look: Complexion) -> Paint:
    p, one = atlas.points[texels], np.ones(len(texels))
    weave = noise(p * [1, 0.5, 1], 1.3 * MM, look.seed + 40, 2)
    shade = 1 + 0.18 * weave + 0.06 * noise(p, 0.03, look.seed + 41, 2)
    folds = 1.2 * MM * noise(p * [1, 0.45, 1], 0.05, look.seed + 42, 2)
    return Paint(look.cloth * shade[:, None], 0.25 * one, 0.7 * one, 0.1 * one, 0.12 * MM * weave + folds)


PAINTERS = {"skin": _skin, "eye": _eye, "teeth": _teeth, "gums": _gums, "cavity": _cavity, "cloth": _cloth}
