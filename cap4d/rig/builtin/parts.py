"""What is set into the skin or worn on it: eyeballs, teeth, tongue, ears, hair, shirt. Half of each, in
millimetres.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.rig.builtin.field import EYE, EYE_RADIUS, cast
from cap4d.rig.builtin.sheet import Grid, Part, curve, smoothstep

PUPIL, IRIS = 0.165, 0.445  # rad from the gaze axis
MOUTH_HEIGHT = -53.5


def grid_part(
    name: str,
    points: np.ndarray,
    uv: np.ndarray,
    *,
    pole: bool = False,
    end_pole: bool = False,
    ring: bool = False,
    **marks,
) -> Part:
    """A part of one grid [R, C, 3].

    Args:
        pole, end_pole: The first, the last row is one point.
        ring: The last column is the first.
    """
    rows, columns = points.shape[:2]
    ids = np.arange(rows * columns).reshape(rows, columns)
    if ring:
        ids[:, -1] = ids[:, 0]
    if pole:
        ids[0] = ids[0, 0]
    if end_pole:
        ids[-1] = ids[-1, 0]
    used = np.unique(ids)
    new = np.zeros(rows * columns, int)
    new[used] = np.arange(len(used))
    flat = {k: np.broadcast_to(m, (rows, columns)).reshape(-1)[used] for k, m in marks.items()}
    return Part(name, points.reshape(-1, 3)[used], (Grid(new[ids], uv),), np.zeros((len(used), 3)), flat)


def disc_uv(radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[..., 2] a point of the unit square at `radius` in [0, 1] from its middle; angle 0 is up, growing to
    the right.
    """
    return 0.5 + 0.5 * np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1)


def square_uv(radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """The same with the rim on the square's edges, so that it stays straight in the grid."""
    sin, cos = np.sin(angle), np.cos(angle)
    return 0.5 + 0.5 * (radius / np.maximum(np.abs(sin), np.abs(cos)))[..., None] * np.stack([sin, cos], -1)


def fan_uv(radius: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """[..., 2] for a half part about a pole: the pole at the top's middle, the rim on the other edges.

    Args:
        radius: In [0, 1] from the pole to the rim.
        azimuth: rad, 0 in front (straight down) to pi behind (straight to the right).
    """
    u, v = np.moveaxis(square_uv(radius, np.pi - 0.5 * azimuth), -1, 0)
    return np.stack([u, 2 * v], -1)


def build_eye() -> Part:
    """The front of an eyeball: rings about the gaze, close together where pupil and iris end."""
    rings = np.array(
        [
            0,
            0.08,
            0.150,
            PUPIL,
            0.18,
            0.26,
            0.34,
            0.41,
            IRIS - 0.015,
            IRIS + 0.01,
            0.5,
            0.6,
            0.75,
            0.95,
            1.2,
            1.4,
            1.6,
        ]
    )
    around = np.linspace(0, 2 * np.pi, 41)
    a, phi = np.meshgrid(rings, around, indexing="ij")
    radius = EYE_RADIUS + 0.35 * smoothstep(IRIS + 0.05, 0.1, a)
    points = EYE + radius[..., None] * np.stack(
        [np.sin(a) * np.sin(phi), np.sin(a) * np.cos(phi), np.cos(a)], -1
    )
    uv = disc_uv((a / rings[-1]) ** 0.62, phi)
    return grid_part("eye", points[:, ::-1], uv[:, ::-1], pole=True, ring=True, angle=a, turn=phi[:, ::-1])


def arch(tau: np.ndarray, width: float, front: float, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """x and z of a dental arch at parameter tau in [0, 1]."""
    angle = 1.35 * tau
    return width * np.sin(angle), front - depth * (1 - np.cos(angle))


def build_teeth(name: str, sign: float, width: float, front: float, edge: float, gum: float) -> Part:
    """A row of teeth with its gum: from behind the gum's top over the front of the crowns to behind their
    edges.

    Args:
        sign: 1 for the upper row, -1 for the lower.
        edge, gum: Heights of the biting edge and of the gum line, mm.
    """
    bounds = np.array([0, 8.2, 14.6, 21.6, 28.0, 34.5, 43.0]) * (1.0 if sign > 0 else 0.74)
    tau = np.linspace(0, 1, 50)
    x, z = arch(tau, width, front, 30.0)
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
    tooth = np.clip(np.searchsorted(bounds, length, "right") - 1, 0, len(bounds) - 2)
    across = np.clip((length - bounds[tooth]) / (bounds[tooth + 1] - bounds[tooth]), 0, 1)
    crown = 1 - np.abs(2 * across - 1) ** 5
    gap = 1 - np.abs(2 * across - 1) ** 8
    # rows: height share from gum (0) to edge (1), how far forward (mm), which share of the scallop shows
    rows = np.array(
        [
            [-0.75, -2.5, 0],
            [-0.35, 0.6, 0],
            [-0.04, 0.8, 0.2],
            [0.06, 0.2, 0.6],
            [0.3, 0.9, 1],
            [0.6, 1.1, 1],
            [0.85, 0.8, 1],
            [0.97, 0.2, 1],
            [1.0, -0.8, 0.8],
            [0.7, -3.2, 0.2],
        ]
    )
    normal = np.stack([x * 0.55 + 1e-9, 0 * x, np.full_like(x, 18.0)], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = gum + (edge - gum) * rows[:, :1]
    scallop = 0.9 * (gap - 1) * rows[:, 2:]
    rounding = sign * 0.9 * (1 - crown) * smoothstep(0.5, 1.0, rows[:, :1])
    points = np.stack(
        [
            np.broadcast_to(x, height.shape[:1] + x.shape),
            height + rounding,
            np.broadcast_to(z, height.shape[:1] + x.shape),
        ],
        -1,
    )
    points = points + (rows[:, 1:2] + scallop)[..., None] * normal
    points[:, 0, 0] = 0
    order = slice(None) if sign > 0 else slice(None, None, -1)
    u, v = np.meshgrid(np.linspace(0.5, 1, len(tau)), np.linspace(1, 0, len(rows)))
    share = np.broadcast_to(rows[:, :1], v.shape)
    return grid_part(
        name,
        points[order],
        np.stack([u, v], -1),
        enamel=share[order],
        gap=np.broadcast_to(gap, v.shape)[order],
    )


def build_tongue() -> Part:
    """A flat rounded tongue, a closed form with its poles at the tip and the root."""
    s, phi = np.meshgrid(np.linspace(0, 1, 15), np.linspace(0, np.pi, 13), indexing="ij")
    along = np.pi * s
    girth = np.sin(along) ** 0.62
    points = np.stack(
        [
            17 * girth * np.sin(phi),
            -62
            + 6.0 * girth * np.cos(phi)
            - 1.2 * girth * np.exp(-((phi / 0.35) ** 2))
            + 3 * np.sin(along * 0.5) ** 2,
            46 + 25 * np.cos(along),
        ],
        -1,
    )
    points[:, [0, -1], 0] = 0
    uv = np.stack([0.5 + 0.5 * phi / np.pi, s], -1)
    return grid_part("tongue", points[::-1], uv[::-1], pole=True, end_pole=True, tip=1 - s[::-1])


def build_ear() -> Part:
    """An ear as a disc seen from its side: bowl, inner ridge, groove, rolled rim; then its back down to the
    head.
    """
    rho = np.concatenate([np.linspace(0, 1, 17), [1.0, 0.97, 0.88, 0.76, 0.66]])
    back = np.arange(len(rho)) > 16
    phi = np.linspace(0, 2 * np.pi, 49)  # 0 is up, growing towards the face
    r, f = np.meshgrid(rho, phi, indexing="ij")
    behind = np.broadcast_to(back[:, None], r.shape)
    up, fore = np.cos(f), np.sin(f)
    tall = np.where(up > 0, 29.0, 31.0)
    wide = np.where(fore > 0, 13.0, 19.0) * (1 + 0.16 * up - 0.06 * (up < 0) * up**2)
    b, a = tall * up * r, -wide * fore * r  # up and backward in the ear's plane
    lobe = smoothstep(-0.45, -0.95, np.cos(f) * np.minimum(r * 1.2, 1))
    face = smoothstep(0.2, 0.9, fore)
    bump = lambda c, w: np.exp(-(((r - c) / w) ** 2))  # noqa: E731
    height = (
        -6.0 * smoothstep(0.52, 0.12, r)
        + 3.0 * bump(0.62, 0.12) * (1 - face)
        - 1.8 * bump(0.78, 0.07) * (1 - face)
    )
    height += 3.6 * bump(0.93, 0.085) * (1 - 0.75 * lobe) + 2.0 * lobe * bump(0.7, 0.3)
    height += 4.5 * face * np.exp(-(((b + 4) / 6.5) ** 2)) * bump(0.62, 0.2)  # tragus
    height -= 5.0 * face * smoothstep(0.72, 1.0, r)  # the front edge sinks into the cheek
    height = np.where(
        behind, np.array([0] * 17 + [-1.5, -4.0, -6.5, -9.0, -12.0])[:, None] - 5 * face, height
    )
    tilt = np.radians(27)
    backward = np.array([np.sin(tilt), -0.12, -np.cos(tilt)])
    outward = np.array([np.cos(tilt), 0.05, np.sin(tilt)])
    upward = np.array([0.10, 0.985, -0.14])
    points = (
        np.array([77.0, 3.0, -9.0])
        + a[..., None] * backward
        + b[..., None] * upward
        + height[..., None] * outward
    )
    uv = square_uv(
        np.where(
            behind,
            0.8 + 0.2 * np.linspace(0, 1, 5)[np.maximum(np.arange(len(rho)) - 17, 0)][:, None],
            r * 0.8,
        ),
        f,
    )
    uv[..., 0] = 1 - uv[..., 0]
    return grid_part("ear", points, uv, pole=True, ring=True, height=height, rho=r, behind=behind * 1.0)


# By azimuth in degrees, for both sides: the hair's edge on the skin, mm.
HAIRLINE_AT = (0, 12, 24, 34, 44, 53, 61, 67, 71, 74, 80, 83, 87, 95, 107, 116, 124, 140, 160, 180)
HAIRLINE = (85, 86, 87, 82, 70, 54, 40, 24, 8, 4, 4, 16, 32, 41, 35, 10, -16, -42, -56, -58)
# By signed azimuth (positive to the person's left): how far it stands off the skull, mm. Combed from a
# parting on the left.
THICKNESS_AT = (-180, -140, -110, -84, -66, -45, -22, 0, 16, 30, 50, 70, 84, 110, 140, 180)
THICKNESS = (8, 9, 9, 6, 8, 14, 22, 21, 16, 10, 8, 5.5, 5, 8, 9, 8)


def build_hair() -> Part:
    """Short hair combed to the side: a shell from the crown to the hairline, its edge under the skin.

    The only part whose halves differ; they agree on the midline.
    """
    left, uv, marks = _hair_half(1)
    right, _, other = _hair_half(-1)
    for mine, theirs in ((left, right), *((marks[k], other[k]) for k in marks)):
        theirs[:, [0, -1]] = mine[:, [0, -1]]
    part = grid_part("hair", left, uv, pole=True, **marks)
    mirror = grid_part("hair", right, uv, pole=True, **other)
    return replace(part, other=mirror)


def _hair_half(side: float) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """[R, C, 3] points (both halves at x >= 0), uv and marks; `side` is 1 for the person's left."""
    theta = np.concatenate([np.linspace(0, 60, 34), np.linspace(60, 180, 45)[1:]])
    angle = np.radians(theta)
    outward = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    ends = smoothstep(0, 12, theta) * smoothstep(180, 165, theta)
    line = (
        curve(theta, list(zip(HAIRLINE_AT, HAIRLINE, strict=True)), soft=2.2)
        + 0.7 * np.sin(0.9 * theta * side) * ends
    )
    edge = cast(np.stack([0 * line, line, 0 * line], -1), outward)
    centre = np.array([0, 40.0, -12.0])
    crown = np.array([0, 1.0, -0.42]) / np.hypot(1, 0.42)
    arm = (edge - centre) / np.linalg.norm(edge - centre, axis=1, keepdims=True)
    full = np.arccos(np.clip(arm @ crown, -1, 1))
    s = np.concatenate([np.linspace(0, 0.88, 27), [0.91, 0.935, 0.955, 0.972, 0.986, 0.995, 1.0]])
    turn = s[:, None] * full
    across = arm - (arm @ crown)[:, None] * crown
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rays = np.cos(turn)[..., None] * crown + np.sin(turn)[..., None] * across
    skull = cast(np.broadcast_to(centre, rays.shape).reshape(-1, 3), rays.reshape(-1, 3)).reshape(rays.shape)
    locks = strands(turn, side * angle)
    thick = curve(side * theta, list(zip(THICKNESS_AT, THICKNESS, strict=True)), soft=7.0)
    thick = 12 + (thick - 12) * smoothstep(0.1, 0.75, s)[:, None]
    profile = (np.maximum(1 - s**8, 0) ** 0.6)[:, None]
    rise = profile * (thick * (0.95 + 0.1 * locks) + 3.4 * (locks - 0.5)) - 2.0 * s[:, None] ** 12
    points = skull + rise[..., None] * rays
    points[:, [0, -1], 0] = 0
    share = np.broadcast_to(s[:, None], turn.shape).copy()
    return points, fan_uv(share, np.broadcast_to(angle, share.shape)), {"lock": locks, "share": share}


def strands(turn: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[R, C] in [0, 1]: locks that lean to the person's right, sharp in their partings and round on their
    backs.
    """
    lean = angle[None] + 0.55 * turn * np.cos(0.5 * angle)[None] ** 2
    broad = np.abs(np.sin(8.5 * lean + 0.9 * np.sin(3 * turn + 2 * lean)))
    fine = np.abs(np.sin(19 * lean + 1.3 * np.sin(4 * turn - 1.5 * lean) + 0.8))
    return (0.68 * broad**0.7 + 0.32 * fine**0.8) * smoothstep(0.02, 0.35, turn) + 0.6 * smoothstep(
        0.35, 0.02, turn
    )


def build_shirt() -> Part:
    """A crew-neck shirt over neck, shoulders and chest, open below."""
    theta = np.radians(np.linspace(0, 180, 41))
    # rows: half width, half depth, height in front / at the side / behind, mm
    rings = np.array(
        [
            [52, 52, -154, -138, -126],
            [55, 55, -153, -136, -124],
            [57.5, 57, -154, -136, -124],
            [59, 58.5, -157, -139, -127],
            [60, 60, -162, -143, -131],
            [63, 62, -166, -146, -134],
            [78, 68, -174, -152, -141],
            [102, 76, -185, -159, -151],
            [130, 84, -199, -167, -162],
            [156, 92, -215, -176, -176],
            [177, 99, -233, -189, -193],
            [192, 105, -253, -209, -213],
            [200, 109, -276, -234, -236],
            [203, 112, -300, -262, -264],
            [203, 114, -324, -294, -294],
            [201, 115, -345, -330, -330],
        ]
    )
    wide, deep, front, side, back = rings.T[..., None]
    bend = np.cos(theta)
    height = np.where(bend > 0, side + (front - side) * bend**2, side + (back - side) * bend**2)
    squareness = np.linspace(1.0, 0.82, len(rings))[:, None]
    x = wide * np.abs(np.sin(theta)) ** squareness
    z = deep * np.sign(bend) * np.abs(bend) ** squareness - 40
    points = np.stack([x, height, z], -1)
    points[:, [0, -1], 0] = 0
    band = np.broadcast_to((np.arange(len(rings)) < 6)[:, None] * 1.0, x.shape)
    share = np.broadcast_to(np.linspace(0.25, 1, len(rings))[:, None], x.shape)
    uv = fan_uv(share, np.broadcast_to(theta, x.shape))
    return grid_part("shirt", points, uv, band=band)
