"""The skin from the hidden scalp to the neck: one grid of rows and columns that opens at the eyes and at the
mouth.

Columns are half-planes of constant azimuth about the vertical axis (0 is the face's middle, 180 the back).
Rows are lofted between landmark lines (KEYS), and two of the rows are doubled where the lids and the lips
part, so that lid and lip rims are clean edge loops. The rows inside lids and lips, and the mouth's pouch,
hang on those rims.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from cap4d.rig.builtin.field import EYE, EYE_RADIUS, cast, settle
from cap4d.rig.builtin.sheet import Grid, Part, curve, smoothstep

CORNER = 16.5  # deg; the inner eye corner and the mouth corner share a column
OUTER = 37.0  # deg; outer eye corner
SPANS = ((0.0, CORNER, 17), (CORNER, OUTER, 20), (OUTER, 60.0, 12), (60.0, 120.0, 15), (120.0, 180.0, 8))
CORNER_COLUMN, OUTER_COLUMN = 17, 37

# Landmark lines: name, number of rows from the line above, and height in mm at AZIMUTHS (deg).
AZIMUTHS = (0, 10, 16, 25, 31, 38, 48, 60, 80, 95, 112, 132, 150, 180)
KEYS = (
    ("hidden", 0, (101, 100.3, 99.9, 99.3, 98.3, 93.8, 87.3, 72.7, 54, 52, 40, 0, -25, -32)),
    ("hair", 4, (78, 77.3, 76.9, 76.3, 75.3, 70.4, 63.4, 53.5, 41.5, 35.3, 26, -8, -36, -42)),
    ("brow_top", 7, (53, 53.4, 53.6, 54, 52.6, 51, 45.7, 39, 28.7, 23.3, 14, -14, -42, -48)),
    ("brow", 8, (42, 42.4, 42.6, 43, 41.6, 40, 35.9, 31.2, 24.7, 19.3, 10, -18, -46, -52)),
    ("crease", 8, (31, 30.4, 30, 29.6, 29.3, 28.6, 25, 20, 14, 8, -2, -28, -54, -60)),
    ("upper_lid", 7, (18.5, 18.3, 18.2, 19, 19.5, 19.7, 17, 12.7, 6, 0, -10, -35, -60, -66)),
    ("lower_lid", 1, (18.5, 18.3, 18.2, 19, 19.5, 19.7, 17, 12.7, 6, 0, -10, -35, -60, -66)),
    ("under_lid", 6, (8, 8, 8, 6.5, 7.8, 8.8, 6.5, 2.7, -5, -10, -19, -41, -65, -70)),
    ("nose", 22, (-31, -31, -31, -31, -31.1, -32.1, -33.6, -36, -38, -39, -42, -56, -74, -78)),
    (
        "upper_vermilion",
        7,
        (-46, -46.3, -46.5, -46.8, -47.1, -47.5, -48.2, -49, -49, -50, -52, -63, -79, -83),
    ),
    ("upper_lip", 7, (-53.7, -53.4, -52.5, -53.4, -54.2, -55.6, -57.2, -58, -58, -60, -61, -69, -84, -87)),
    ("lower_lip", 1, (-53.7, -53.4, -52.5, -53.4, -54.2, -55.6, -57.2, -58, -58, -60, -61, -69, -84, -87)),
    ("lower_vermilion", 7, (-64, -63.5, -63.2, -62.8, -62.5, -62.8, -63, -63, -63, -65, -66, -73, -87, -90)),
    ("chin", 12, (-86, -84.8, -84, -82.9, -82.1, -81.2, -78.2, -74, -70, -70, -75.4, -85.6, -97, -99)),
    ("jaw", 8, (-102, -101, -100.4, -97.8, -95, -91.9, -87, -81, -74, -74, -80.8, -93.2, -107, -110)),
    (
        "throat",
        9,
        (-120, -119, -118.4, -117.5, -116.9, -116.2, -112.8, -108, -102.3, -98, -99.4, -108.8, -122, -125),
    ),
    ("collar", 10, (-195, -195, -195, -195, -195, -195, -195, -195, -195, -195, -195, -195, -195, -195)),
)
EYE_OPEN = (6.6, -5.6)  # mm the lid rims bow up and down from the line between the corners
LIP_ROWS, LID_ROWS = 4, 3


def azimuths() -> np.ndarray:
    """[C] deg, the columns of the left half."""
    spans = [np.linspace(a, b, n, endpoint=False) for a, b, n in SPANS]
    return np.concatenate([*spans, [180.0]])


def row_of(key: str) -> int:
    """The row that lies on a landmark line."""
    counts = np.cumsum([n for _, n, _ in KEYS])
    return int(counts[[k for k, _, _ in KEYS].index(key)])


def lid_bow(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the upper and the lower lid's rim bow from the line between the eye's corners, mm."""
    u = np.clip((theta - CORNER) / (OUTER - CORNER), 0, 1)
    upper = EYE_OPEN[0] * np.sin(np.pi * u**0.86) ** 0.72
    lower = EYE_OPEN[1] * np.sin(np.pi * u**1.12) ** 0.85
    return upper, lower


def vermilion(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights in mm of the red of the upper and lower lip at u in [0, 1] from the middle to the corner."""
    arch = np.maximum(1 - u**2.2, 0) ** 0.8
    upper = 7.2 * arch + 1.0 * np.exp(-(((u - 0.24) / 0.13) ** 2)) - 0.6 * np.exp(-((u / 0.1) ** 2))
    lower = 9.6 * np.maximum(1 - u**2.1, 0) ** 0.85
    return upper, lower


def row_heights(theta: np.ndarray) -> np.ndarray:
    """[R, C] the height of every row at every column, mm."""
    lines = {
        key: curve(theta, list(zip(AZIMUTHS, heights, strict=True)), soft=4.0) for key, _, heights in KEYS
    }
    up, low = lid_bow(theta)
    lines["upper_lid"] = lines["upper_lid"] + up
    lines["lower_lid"] = lines["lower_lid"] + low
    lines["crease"] = np.maximum(lines["crease"], lines["upper_lid"] + 5.5 * smoothstep(60, 30, theta) + 1)
    red_up, red_low = vermilion(np.clip(theta / CORNER, 0, 1))
    inside = smoothstep(CORNER + 9, CORNER - 3, theta)
    lines["upper_vermilion"] = (1 - inside) * lines["upper_vermilion"] + inside * (
        lines["upper_lip"] + np.maximum(red_up, 1.4)
    )
    lines["lower_vermilion"] = (1 - inside) * lines["lower_vermilion"] + inside * (
        lines["lower_lip"] - np.maximum(red_low, 1.4)
    )
    rows = [lines[KEYS[0][0]][None]]
    for (above, _, _), (below, n, _) in pairwise(KEYS):
        t = np.arange(1, n + 1)[:, None] / n
        rows.append((1 - t) * lines[above] + t * lines[below])
    return np.concatenate(rows)


def skin_grid() -> tuple[np.ndarray, np.ndarray]:
    """[R, C, 3] points of the main grid on the bare head, mm, and [C] azimuths."""
    theta = azimuths()
    heights = row_heights(theta)
    jaw, throat = row_of("jaw"), row_of("throat")
    rows, columns = heights.shape
    axis = np.zeros(rows)
    axis[jaw:] = np.interp(np.arange(jaw, rows), [jaw, throat, rows], [0, -30, -38])
    origins = np.zeros((rows, columns, 3))
    origins[..., 1], origins[..., 2] = heights, axis[:, None]
    angle = np.radians(theta)
    directions = np.broadcast_to(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1), origins.shape)
    points = cast(origins.reshape(-1, 3), directions.reshape(-1, 3)).reshape(rows, columns, 3)
    for r in range(jaw + 1, throat):  # the underside of the jaw, where level rays graze
        t = (r - jaw) / (throat - jaw)
        points[r] = (1 - t) * points[jaw] + t * points[throat]
    under = slice(jaw + 1, throat)
    points[under] = settle(points[under].reshape(-1, 3)).reshape(points[under].shape)
    points[:, [0, -1], 0] = 0
    return relax(points, theta), theta


def relax(points: np.ndarray, theta: np.ndarray, rounds: int = 3) -> np.ndarray:
    """[R, C, 3] the grid evened out along the surface, away from the landmark lines of eyes and lips."""
    row = np.arange(len(points))[:, None]
    near_eye = smoothstep(row_of("brow_top"), row_of("crease"), row)
    near_eye = near_eye * smoothstep(row_of("under_lid") + 6, row_of("under_lid"), row)
    near_eye = near_eye * smoothstep(CORNER - 5, CORNER - 1, theta) * smoothstep(OUTER + 8, OUTER, theta)
    near_lips = smoothstep(row_of("upper_vermilion") - 3, row_of("upper_vermilion"), row)
    near_lips = near_lips * smoothstep(row_of("lower_vermilion") + 4, row_of("lower_vermilion"), row)
    near_lips = near_lips * smoothstep(CORNER + 14, CORNER + 3, theta)
    once = np.setdiff1d(row, [row_of("lower_lid"), row_of("lower_lip")])  # doubled rows count once
    share = (0.6 * (1 - np.maximum(near_eye, near_lips)))[once, :, None]
    share[[0, -1]] = 0
    smooth = points[once]
    for _ in range(rounds):
        for _ in range(3):
            wide = np.concatenate([smooth[:, 1:2] * [-1, 1, 1], smooth, smooth[:, -2:-1] * [-1, 1, 1]], 1)
            mean = 0.25 * (wide[:, :-2] + wide[:, 2:])
            mean[1:-1] += 0.25 * (smooth[:-2] + smooth[2:])
            smooth = smooth + share * (mean - smooth)
        smooth = settle(smooth.reshape(-1, 3), 1).reshape(smooth.shape)
        smooth[:, [0, -1], 0] = 0
    points = points.copy()
    points[once] = smooth
    for below, first, last in (("lower_lid", CORNER_COLUMN, OUTER_COLUMN), ("lower_lip", -1, CORNER_COLUMN)):
        column = np.arange(len(theta))
        closed = (column <= first) | (column >= last)
        points[row_of(below), closed] = points[row_of(below) - 1, closed]
    return points


def lip_relief(points: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """[R, C, 3] the main grid with lips, philtrum and mouth corners raised from the bare head."""
    points = points.copy()
    rows = np.arange(len(points))[:, None]
    top, upper, lower, bottom = (
        row_of(k) for k in ("upper_vermilion", "upper_lip", "lower_lip", "lower_vermilion")
    )
    u = theta / CORNER
    taper = np.maximum(1 - np.minimum(u, 1) ** 2.2, 0) ** 0.85
    t_up = np.clip((rows - top) / (upper - top), -2, 1)
    t_low = np.clip((bottom - rows) / (bottom - lower), -2, 1)
    upper_lip = np.where(
        t_up >= 0,
        1.2 + 4.0 * np.sin(np.pi * 0.62 * np.maximum(t_up, 0)) - 2.9 * np.maximum(t_up, 0) ** 4,
        1.2 * smoothstep(-1.3, 0, t_up),
    )
    lower_lip = np.where(
        t_low >= 0,
        0.5 + 5.9 * np.sin(np.pi * 0.66 * np.maximum(t_low, 0)) - 3.5 * np.maximum(t_low, 0) ** 4,
        0.5 * smoothstep(-0.8, 0, t_low),
    )
    push = taper * np.where(rows <= upper, upper_lip, lower_lip)
    y, line = points[..., 1], points[upper, :, 1]
    corner = np.exp(-(((theta - CORNER) / 3.0) ** 2) - ((y - line) / 5.0) ** 2)
    push = push - 2.0 * corner
    nose = points[row_of("nose"), 0, 1]
    between = smoothstep(nose + 2, nose - 5, y) * smoothstep(points[top, 0, 1] - 3, points[top, 0, 1] + 2, y)
    x = points[..., 0]
    push = push + between * (0.55 * np.exp(-(((x - 5.4) / 2.8) ** 2)) - 0.8 * np.exp(-((x / 3.4) ** 2)))
    fold = rows - row_of("upper_lid") + 0.0 * theta  # the crease over the upper lid
    over_eye = smoothstep(CORNER, CORNER + 5, theta) * smoothstep(OUTER + 4, OUTER - 4, theta)
    push = push + over_eye * (
        0.9 * np.exp(-(((fold + 9.5) / 2.0) ** 2)) - 1.3 * np.exp(-(((fold + 6.8) / 1.1) ** 2))
    )
    angle = np.radians(0.6 * theta)
    points += push[..., None] * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    points[:, 0, 0] = 0
    return points


def inside_lids(rim: np.ndarray, sign: float) -> np.ndarray:
    """[LID_ROWS, K, 3] rows behind a lid's rim [K, 3]: over the rim's edge, then away between lid and
    eyeball.
    """
    arm = rim - EYE
    u = np.linspace(0, 1, len(rim))
    open_ = np.sin(np.pi * u) ** 0.5
    rows = []
    for depth, lift in ((0.0, 0.35), (0.0, 3.2), (0.0, 6.0)):
        moved = arm + sign * lift * open_[:, None] * np.array([0, 1.0, 0]) - 0.8 * np.array([0, 0, 1.0])
        radius = np.linalg.norm(moved, axis=1, keepdims=True)
        wanted = np.minimum(EYE_RADIUS + 0.12 - depth, np.linalg.norm(arm, axis=1, keepdims=True) - 1.0)
        rows.append(EYE + moved / radius * wanted)
    rows = np.stack(rows)
    for k in range(len(rows)):  # both lids share their corners
        for end in (0, -1):
            rows[k, end] = rim[end] + (EYE - rim[end]) * (0.05 + 0.05 * k)
    return rows


def inside_lips(rim: np.ndarray, sign: float) -> np.ndarray:
    """[LIP_ROWS, K, 3] rows behind a lip's rim [K, 3], middle to corner: back over the teeth, then up or
    down.
    """
    u = np.linspace(0, 1, len(rim))
    taper = np.maximum(1 - u**3, 0) ** 0.6
    back = np.array([2.0, 4.5, 6.5, 7.5])[:, None] * (0.55 + 0.45 * taper)
    lift = (
        np.array([-0.35, 0.5, 4.0, 9.0])[:, None] * taper
    )  # first past each other, so that closed lips show no slit
    rows = np.repeat(rim[None], LIP_ROWS, 0)
    rows[..., 2] -= back
    rows[..., 1] += sign * lift
    rows[..., 0] *= 1 - 0.02 * np.arange(1, LIP_ROWS + 1)[:, None]
    return rows


def pouch(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """[Q, K, 3] the mouth's lining from behind the upper lip over the palate to the back and under the
    tongue.
    """
    t = np.linspace(0, 1, 13)[:, None, None]
    middle = 0.5 * (upper + lower) - [0, 1.0, 0]
    half = 0.5 * (upper - lower)
    angle = np.pi * t
    tall = half * np.cos(angle) * (1 + 0.35 * np.sin(angle))
    deep = 46 * np.sin(angle) ** 0.6 * np.array([0, 0, 1.0])
    line = (1 - t) * upper + t * lower
    rows = middle + tall - deep
    rows[0], rows[-1] = line[0], line[-1]
    rows[..., 0] = line[..., 0] * (1 + 0.18 * np.sin(angle[..., 0]))
    return rows


# Heights in the UV atlas of the bands between landmark lines and of the openings, in pixels of the 128-pixel
# grid. The
# rims of lids and lips lie on pixel centres (from the top: 22.5, 29.5, 53.5, 60.5), so that the grid has them
# as edges.
BANDS = (0, 3.5, 5, 5, 4, 5, 0, 4, 10.5, 4.5, 5, 0, 5, 7, 4.5, 5.5, 4.5)
EYE_HOLE, MOUTH_HOLE = 7.0, 7.0
INSIDE_LID, INSIDE_LIP = (
    (0, 1.0, 1.5, 2.01),
    (0, 0.7, 1.2, 1.7, 2.01),
)  # pixels from the rim of the rows behind it
SKIN_HEIGHT = sum(BANDS) + EYE_HOLE + MOUTH_HOLE


def skin_uv(theta: np.ndarray) -> np.ndarray:
    """[R, C, 2] in [0.5, 1] x [0, 1]: rows and columns with the openings drawn apart, so that no cell bridges
    them.
    """
    weight = np.where(np.arange(len(theta) - 1) < OUTER_COLUMN + 12, 1.0, 0.8)
    u = np.concatenate([[0], np.cumsum(weight)])
    u = 0.5 + 0.5 * u / u[-1]
    column = np.arange(len(theta))
    e = np.clip((column - CORNER_COLUMN) / (OUTER_COLUMN - CORNER_COLUMN), 0, 1)
    eye = EYE_HOLE / 2 * np.clip(7 * np.minimum(e, 1 - e), 0, 1) ** 0.7
    mouth = MOUTH_HOLE / 2 * np.clip(6 * (1 - column / CORNER_COLUMN), 0, 1) ** 0.7
    lines, depth = [], 0.0
    for (key, _, _), band in zip(KEYS, BANDS, strict=True):
        depth += band + {"lower_lid": EYE_HOLE, "lower_lip": MOUTH_HOLE}.get(key, 0)
        line = np.full(len(theta), depth)
        line += {"upper_lid": EYE_HOLE / 2 - eye, "lower_lid": eye - EYE_HOLE / 2}.get(key, 0)
        line += {"upper_lip": MOUTH_HOLE / 2 - mouth, "lower_lip": mouth - MOUTH_HOLE / 2}.get(key, 0)
        lines.append(line)
    rows = [lines[0][None]]
    for k in range(1, len(KEYS)):
        t = np.arange(1, KEYS[k][1] + 1)[:, None] / KEYS[k][1]
        rows.append((1 - t) * lines[k - 1] + t * lines[k])
    v = 1 - np.concatenate(rows) / SKIN_HEIGHT
    return np.stack([np.broadcast_to(u, v.shape), v], -1)


# The rows behind each rim: which one, over which columns, to which side (1 up, -1 down), and how it is made.
EYE_COLUMNS, LIP_COLUMNS = np.arange(CORNER_COLUMN, OUTER_COLUMN + 1), np.arange(0, CORNER_COLUMN + 1)
STRIPS = (
    ("upper_lid", EYE_COLUMNS, 1, inside_lids),
    ("lower_lid", EYE_COLUMNS, -1, inside_lids),
    ("upper_lip", LIP_COLUMNS, 1, inside_lips),
    ("lower_lip", LIP_COLUMNS, -1, inside_lips),
)


def build_skin() -> tuple[Part, Part]:
    """The skin with the insides of lids and lips, and the mouth's pouch, which hangs on these.

    Marks of the skin: `row` and `column` of the main grid (rows inside lids and lips carry their rim's row),
    `depth` 0 on the outside, 1.. for rows behind a rim.
    """
    bare, theta = skin_grid()
    points, uv = lip_relief(bare, theta), skin_uv(theta)
    ids = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    _join_outside_openings(ids, points)
    cloud = [points.reshape(-1, 3)]
    marks = [np.stack([*np.indices(ids.shape), np.zeros_like(ids)], -1).reshape(-1, 3)]
    grids = [Grid(ids, uv, (row_of("upper_lid"), row_of("upper_lip")))]
    strips, count = {}, ids.size
    for name, columns, sign, make in STRIPS:
        row = row_of(name)
        strip = make(points[row, columns], sign)
        strip_ids = count + np.arange(strip.shape[0] * strip.shape[1]).reshape(strip.shape[:2])
        count += strip_ids.size
        if sign < 0:  # below and above meet in the corners
            ends = (0, -1) if "lid" in name else (-1,)
            strip_ids[:, ends] = strips[name.replace("lower", "upper")][1:, ends]
        strips[name] = np.concatenate([ids[row, columns][None], strip_ids])
        cloud.append(strip.reshape(-1, 3))
        depth = np.arange(1, len(strip) + 1)[:, None]
        marks.append(np.stack(np.broadcast_arrays(row, columns, depth), -1).reshape(-1, 3))
        grids.append(Grid(strips[name][::sign], _strip_uv(name, uv, columns)[::sign]))
    cloud, marks = np.concatenate(cloud), np.concatenate(marks)
    lining = pouch(cloud[strips["upper_lip"][-1]], cloud[strips["lower_lip"][-1]])
    used, new = np.unique(np.concatenate([g.ids.ravel() for g in grids]), return_inverse=True)
    cuts = np.cumsum([g.ids.size for g in grids])[:-1]
    renumbered = zip(grids, np.split(new, cuts), strict=True)
    grids = tuple(Grid(n.reshape(g.ids.shape), g.uv, g.holes) for g, n in renumbered)
    named = dict(zip(("row", "column", "depth"), marks[used].T, strict=True))
    return Part("skin", cloud[used], grids, np.zeros((len(used), 3)), named), pouch_part(lining)


def _join_outside_openings(ids: np.ndarray, points: np.ndarray) -> None:
    """Makes the two rows at the eyes and at the mouth one, but for the columns that open (in place)."""
    for above, below, inner in (
        (row_of("upper_lid"), row_of("lower_lid"), EYE_COLUMNS[1:-1]),
        (row_of("upper_lip"), row_of("lower_lip"), LIP_COLUMNS[:-1]),
    ):
        shared = np.setdiff1d(np.arange(ids.shape[1]), inner)
        ids[below, shared] = ids[above, shared]
        points[below, shared] = points[above, shared]


def _strip_uv(name: str, uv: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """[1 + n, K, 2] from a rim towards the middle of its opening in the atlas."""
    kind = name.split("_")[1]
    steps, hole = (INSIDE_LID, EYE_HOLE) if kind == "lid" else (INSIDE_LIP, MOUTH_HOLE)
    middle = 0.5 * (uv[row_of(f"upper_{kind}"), columns] + uv[row_of(f"lower_{kind}"), columns])
    share = np.array(steps)[:, None, None] / (hole / 2)
    return (1 - share) * uv[row_of(name), columns] + share * middle


def pouch_part(lining: np.ndarray) -> Part:
    """The pouch as a part; at the corner its upper and lower wall are one. Marks: `row` 0 to 1, `column`."""
    rows, columns = lining.shape[:2]
    ids = np.arange(rows * columns).reshape(rows, columns)
    ids[(rows + 1) // 2 :, -1] = ids[: rows // 2, -1][::-1]
    used, new = np.unique(ids, return_inverse=True)
    u, v = np.meshgrid(np.linspace(0.5, 1, columns), np.linspace(1, 0, rows))
    marks = {"row": np.repeat(np.linspace(0, 1, rows), columns), "column": np.tile(np.arange(columns), rows)}
    grid = Grid(new.reshape(ids.shape), np.stack([u, v], -1))
    marks = {name: mark[used] for name, mark in marks.items()}
    return Part("mouth", lining.reshape(-1, 3)[used], (grid,), np.zeros((len(used), 3)), marks)
