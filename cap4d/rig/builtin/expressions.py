"""The 52 ARKit expressions of the built-in head, each a sum of a few muscle-like moves.

A left-hand move is written once, for the person's left (x > 0); the right-hand one is its mirror image. All
in millimetres; an expression's offsets are those at weight 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cap4d.rig.builtin.field import EYE, EYE_RADIUS, LID_RADIUS
from cap4d.rig.builtin.sheet import Mesh, smoothstep
from cap4d.rig.builtin.skin import CORNER, CORNER_COLUMN, LIP_ROWS, OUTER_COLUMN, azimuths, row_of

HINGE = np.array([0.0, -4.0, -4.0])  # the jaw's joint, just in front of the ears
JAW_OPEN = np.radians(17.5)
LIP_LINE = -53.5


@dataclass(frozen=True, eq=False)
class Face:
    """What the moves need to know of the mesh; all per vertex.

    Args:
        p: [V, 3] mm.
        skin: bool[V].
        below: [V] 0 above the mouth's opening, 1 below it, between at and beyond the corners.
        jaw: [V] how far the vertex follows the lower jaw.
        lid: [V] 1 upper lid, -1 lower lid, 0 neither; `lid_share` how far it follows its rim.
        close: [V] rad about the eyeball's lateral axis by which a vertex's rim turns to meet the other lid.
        lining: For the vertices of the mouth's pouch: their ids, the skin vertices [N, 2] behind the upper
            and the lower lip that they hang on, and their place between these in [0, 1].
    """

    p: np.ndarray
    skin: np.ndarray
    below: np.ndarray
    jaw: np.ndarray
    lid: np.ndarray
    lid_share: np.ndarray
    close: np.ndarray
    lining: tuple[np.ndarray, np.ndarray, np.ndarray]
    mesh: Mesh

    def lump(self, centre: tuple, size: tuple, move: tuple) -> np.ndarray:
        """[V, 3] `move` (mm) spread as a Gaussian of half widths `size` (x, y) about `centre` on the face's
        front.
        """
        share = (
            np.exp(-(((self.p[:, :2] - centre) / size) ** 2).sum(1))
            * smoothstep(5, 35, self.p[:, 2])
            * self.skin
        )
        return share[:, None] * np.array(move, float)

    def upper(self, offsets: np.ndarray) -> np.ndarray:
        """The part of a move that the upper side of the mouth makes."""
        return offsets * (1 - self.below)[:, None]

    def lower(self, offsets: np.ndarray) -> np.ndarray:
        """The part of a move that the lower side of the mouth makes."""
        return offsets * self.below[:, None]

    def lump_both(self, centre: tuple, size: tuple, move: tuple) -> np.ndarray:
        """A lump and its mirror image."""
        left = self.lump(centre, size, move)
        return left + self.mirror(left)

    def mirror(self, offsets: np.ndarray) -> np.ndarray:
        """The same move of the other side of the face."""
        return offsets[self.mesh.partner] * [-1, 1, 1]

    def turn_jaw(self, angles: tuple, shift: tuple = (0, 0, 0)) -> np.ndarray:
        """[V, 3] the lower jaw turned about its hinge (rad about x then y) and shifted (mm)."""
        return self.jaw[:, None] * (turned(self.p, *angles) + np.array(shift, float))

    def lids(self, upper: float, lower: float) -> np.ndarray:
        """[V, 3] the left eye's lids turned about the eyeball: 1 closes, negative opens wider."""
        amount = (
            np.where(self.lid > 0, upper, lower)
            * self.close
            * self.lid_share
            * (self.lid != 0)
            * (self.p[:, 0] > 0)
        )
        arm = self.p - EYE
        radius = np.hypot(arm[:, 1], arm[:, 2])
        angle = np.arctan2(arm[:, 1], arm[:, 2]) + amount
        full = np.linalg.norm(arm, axis=1)
        near = smoothstep(0.15, 0.8, self.lid_share) * np.clip(np.abs(amount) / 0.25, 0, 1)
        lifted = radius * np.maximum(1, (LID_RADIUS + 0.5) / np.maximum(full, 1))  # never through the ball
        outer = full > EYE_RADIUS + 1.0
        radius = np.where(outer, radius + near * (lifted - radius), radius)
        moved = np.stack([arm[:, 0], radius * np.sin(angle), radius * np.cos(angle)], -1)
        return (moved - arm) * (amount != 0)[:, None]

    def line_mouth(self, offsets: np.ndarray) -> np.ndarray:
        """The offsets with the mouth's lining following the lips it hangs on."""
        ids, ends, share = self.lining
        hung = (1 - share)[:, None] * offsets[ends[:, 0]] + share[:, None] * offsets[ends[:, 1]]
        loose = (1 - np.sin(np.pi * share) ** 0.7)[:, None]
        offsets = offsets.copy()
        offsets[ids] = loose * hung + (1 - loose) * offsets[ids]
        return offsets


def turned(p: np.ndarray, about_x: float, about_y: float) -> np.ndarray:
    """[V, 3] how points move that turn with the lower jaw about its hinge (rad about x, then y)."""
    tilt = np.array(
        [[1, 0, 0], [0, np.cos(about_x), -np.sin(about_x)], [0, np.sin(about_x), np.cos(about_x)]]
    )
    swing = np.array(
        [[np.cos(about_y), 0, np.sin(about_y)], [0, 1, 0], [-np.sin(about_y), 0, np.cos(about_y)]]
    )
    arm = p - HINGE
    return arm @ (swing @ tilt).T - arm


def read_face(mesh: Mesh) -> Face:
    """The masks of a mesh at rest."""
    p, row, column = mesh.points, mesh.marks["row"], mesh.marks["column"]
    skin, pouch = mesh.of("skin"), mesh.of("mouth")
    theta = azimuths()[np.clip(column, 0, len(azimuths()) - 1).astype(int)]
    below = _below(p, row, theta, skin)
    grid = _main_grid(mesh)
    jaw = below * smoothstep(100, 48, theta) * _above_neck(row, theta)
    jaw = np.where(skin, jaw, 0)
    jaw[mesh.of("teeth_lower")] = 1
    jaw[mesh.of("tongue")] = smoothstep(15, 45, p[mesh.of("tongue"), 2]) * 0.97
    sidewall = _at_corner(theta[pouch])
    jaw[pouch] = (1 - sidewall) * smoothstep(0.25, 0.75, row[pouch]) + 0.5 * sidewall
    jaw[pouch] *= smoothstep(10, 40, p[pouch, 2])
    lid, share, close = _lids(p, row, column, skin, grid)
    return Face(
        p=p,
        skin=skin,
        below=np.where(skin, below, 0),
        jaw=jaw,
        lid=lid,
        lid_share=share,
        close=close,
        lining=_lining(mesh),
        mesh=mesh,
    )


def _main_grid(mesh: Mesh) -> np.ndarray:
    """int[R, C] vertex ids of the left half of the skin's main grid."""
    marks, skin = mesh.marks, mesh.of("skin") & (mesh.points[:, 0] >= 0) & (mesh.marks["depth"] == 0)
    ids = np.flatnonzero(skin)
    rows, columns = marks["row"][ids].astype(int), marks["column"][ids].astype(int)
    grid = np.full((rows.max() + 1, columns.max() + 1), -1)
    grid[rows, columns] = ids
    for r in range(1, len(grid)):  # rows that share the eye's and mouth's corners with the row above
        grid[r] = np.where(grid[r] < 0, grid[r - 1], grid[r])
    return grid


def _below(p: np.ndarray, row: np.ndarray, theta: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """See `Face.below`: a step at the opening, a slope that widens beyond the corner."""
    lower = row >= row_of("lower_lip")
    beyond = np.maximum(theta - CORNER, 0)
    width = 7 + 0.75 * beyond
    line = LIP_LINE - 0.5 - 0.02 * beyond
    slope = smoothstep(-width, width, line - p[:, 1])
    at_corner = _at_corner(theta)
    opening = (row >= row_of("upper_vermilion") - 8) & (row <= row_of("chin"))
    step = np.where(opening, lower, slope)
    return at_corner * slope + (1 - at_corner) * step


def _at_corner(theta: np.ndarray) -> np.ndarray:
    """0 at the mouth's middle, 1 at its corner and beyond; the rest to 1 is the open mouth's shape."""
    return 1 - np.maximum(1 - np.minimum(theta / CORNER, 1) ** 2.2, 0) ** 0.75


def _above_neck(row: np.ndarray, theta: np.ndarray) -> np.ndarray:
    jaw, throat, collar = row_of("jaw"), row_of("throat"), row_of("collar")
    return (
        1
        - 0.75 * smoothstep(jaw + 1, throat, row)
        - 0.25 * smoothstep(throat, throat + 0.6 * (collar - throat), row)
    )


def _lids(p, row, column, skin, grid):
    """`Face.lid`, `lid_share`, `close`."""
    upper, lower = row_of("upper_lid"), row_of("lower_lid")
    rim_u, rim_l = p[grid[upper]] - EYE, p[grid[lower]] - EYE
    angle_u, angle_l = np.arctan2(rim_u[:, 1], rim_u[:, 2]), np.arctan2(rim_l[:, 1], rim_l[:, 2])
    meet = angle_l + 0.16 * (angle_u - angle_l)
    at = np.clip(column, 0, grid.shape[1] - 1).astype(int)
    arm = np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], -1) - EYE
    angle = np.arctan2(arm[:, 1], arm[:, 2])
    in_eye = skin & (column > CORNER_COLUMN) & (column < OUTER_COLUMN)
    lid = np.where(in_eye & (row <= upper) & (row > row_of("hair")), 1, 0) - np.where(
        in_eye & (row >= lower) & (row < row_of("nose")), 1, 0
    )
    top, bottom = np.radians(50.0), np.radians(-48.0)
    share = np.where(
        lid > 0,
        np.clip(1 - (angle - angle_u[at]) / (top - angle_u[at]), 0, 1) ** 1.35,
        np.clip(1 - (angle_l[at] - angle) / (angle_l[at] - bottom), 0, 1) ** 1.35,
    )
    share = np.where((row == upper) | (row == lower), 1, share) * (lid != 0)
    close = np.where(lid > 0, meet[at] - angle_u[at], meet[at] - angle_l[at]) * (lid != 0)
    return lid, share, close


def _lining(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every vertex of the pouch: its id, the skin vertices behind the upper and lower lip it hangs on,
    its place.
    """
    marks = mesh.marks
    ids = np.flatnonzero(mesh.of("mouth"))
    ends = np.zeros((len(ids), 2), int)
    inner = np.flatnonzero(mesh.of("skin") & (marks["depth"] == LIP_ROWS))
    for k, row in enumerate((row_of("upper_lip"), row_of("lower_lip"))):
        for sign in (1, -1):
            mine = np.flatnonzero(sign * mesh.points[ids, 0] >= 0)
            column = marks["column"][ids[mine]]
            rim = inner[(marks["row"][inner] == row) & (sign * mesh.points[inner, 0] >= 0)]
            corner = inner[(marks["column"][inner] == CORNER_COLUMN) & (sign * mesh.points[inner, 0] > 0)]
            rim = np.concatenate([rim, corner])
            order = np.zeros(CORNER_COLUMN + 1, int)
            order[marks["column"][rim].astype(int)] = rim
            ends[mine, k] = order[column.astype(int)]
    return ids, ends, marks["row"][ids]


Move = Callable[[Face], np.ndarray]


def _corner(f: Face, move: tuple, size: tuple = (13, 12)) -> np.ndarray:
    """The left mouth corner pulled by `move`, lips and cheek following."""
    return f.lump((24.5, -54), size, move)


def eye_blink(f: Face) -> np.ndarray:
    return f.lids(1.0, 1.0)


def look(upper: float, lower: float, aside: float) -> Move:
    """Lids that follow the gaze; `aside` mm towards the temple."""
    return lambda f: (
        f.lids(upper, lower) + f.lump((33, 20), (11, 6), (aside, 0, 0)) * (f.lid_share**2)[:, None]
    )


def eye_squint(f: Face) -> np.ndarray:
    return (
        f.lids(0.14, 2.2)
        + f.lump((38, 2), (16, 9), (0, 1.6, 0.9))
        + f.lump((51, 17), (7, 8), (-0.8, -0.2, 0.3))
    )


def eye_wide(f: Face) -> np.ndarray:
    return f.lids(-0.30, -0.5) + f.lump((33, 42), (20, 9), (0, 1.2, 0))


def jaw_open(f: Face) -> np.ndarray:
    cheeks = f.lump_both((30, -52), (14, 20), (-2.2, 0, -1.6))
    lips = f.upper(f.lump((0, -50), (20, 7), (0, 0.8, -0.8)))
    return f.turn_jaw((JAW_OPEN, 0)) + cheeks + lips


def jaw_forward(f: Face) -> np.ndarray:
    return f.turn_jaw((0, 0), (0, -0.8, 6.0))


def jaw_left(f: Face) -> np.ndarray:
    return f.turn_jaw((0, np.radians(5.0)), (2.0, 0, 0))


def mouth_close(f: Face) -> np.ndarray:
    """What brings the lips together again under an open jaw (ARKit: at the same weight as jawOpen).

    Both lips then ride along with half the jaw's turn, as the mouth's corners do.
    """
    row, column = f.mesh.marks["row"], f.mesh.marks["column"]
    half_way = 0.5 * turned(f.p, JAW_OPEN, 0.0)
    reach = smoothstep(row_of("nose") + 1, row_of("upper_vermilion") + 2, row)
    reach = reach * smoothstep(row_of("chin") - 1, row_of("lower_vermilion") - 3, row)
    rim = smoothstep(row_of("upper_vermilion") - 2, row_of("upper_lip") - 2, row)
    rim = rim * smoothstep(row_of("lower_vermilion") + 2, row_of("lower_lip") + 2, row)
    aside = rim * smoothstep(CORNER_COLUMN + 6, CORNER_COLUMN, column)
    aside = aside + (1 - rim) * smoothstep(CORNER_COLUMN + 5, CORNER_COLUMN - 7, column)
    return (reach * aside * f.skin)[:, None] * (half_way - jaw_open(f))


def mouth_funnel(f: Face) -> np.ndarray:
    corners = f.lump_both((23, -54), (11, 12), (-6.5, 0, 3.0))
    rim = f.lump((0, -54), (22, 15), (0, 0, 6.0))
    part = f.upper(f.lump((0, -50), (13, 10), (0, 3.6, 1.5))) + f.lower(
        f.lump((0, -59), (13, 11), (0, -4.4, 1.5))
    )
    return corners + rim + part + f.turn_jaw((np.radians(3.0), 0))


def mouth_pucker(f: Face) -> np.ndarray:
    corners = f.lump_both((23, -54), (12, 12), (-9.5, 0, 4.0))
    rim = f.lump((0, -54), (18, 13), (0, 0, 7.0))
    plump = f.upper(f.lump((0, -49), (12, 6), (0, 1.6, 0.5))) + f.lower(
        f.lump((0, -60), (12, 6), (0, -1.6, 0.5))
    )
    return corners + rim + plump


def mouth_left(f: Face) -> np.ndarray:
    return (
        f.lump((0, -54), (34, 18), (7.0, 0, 0))
        + f.lump((27, -54), (12, 12), (1.0, 0.8, -3.0))
        + f.lump((-25, -54), (12, 12), (0.6, 0, 1.6))
    )


def mouth_smile(f: Face) -> np.ndarray:
    corner = _corner(f, (6.5, 7.5, -4.2), (13, 13))
    cheek = f.lump((40, -24), (15, 14), (1.6, 4.2, 2.6))
    fold = f.lump((29, -37), (4.5, 12), (0, 0, -1.3)) + f.lump((38, -36), (8, 13), (1.2, 1.4, 1.4))
    upper = f.upper(f.lump((11, -48), (11, 7), (1.2, 1.6, -1.2)))
    lower = f.lower(f.lump((11, -60), (11, 8), (1.0, 1.0, -0.8)))
    return corner + cheek + fold + upper + lower + f.lids(0.03, 0.5)


def mouth_frown(f: Face) -> np.ndarray:
    return (
        _corner(f, (1.2, -6.5, -1.2), (11, 12))
        + f.lump((22, -70), (10, 9), (0.5, -1.8, 1.0))
        + f.lower(f.lump((0, -62), (14, 7), (0, 0.9, 0.6)))
    )


def mouth_dimple(f: Face) -> np.ndarray:
    return (
        _corner(f, (5.0, 1.0, -3.8), (9, 9))
        + f.lump((33, -52), (5, 8), (0.5, 0, -2.2))
        + f.lump((40, -45), (8, 12), (1.2, 0.5, 1.4))
    )


def mouth_stretch(f: Face) -> np.ndarray:
    return (
        _corner(f, (7.5, -3.0, -4.6), (12, 13))
        + f.lower(f.lump((12, -62), (13, 9), (2.2, -1.6, -1.0)))
        + f.lump((26, -80), (12, 14), (2.0, -1.5, 0))
    )


def mouth_roll_lower(f: Face) -> np.ndarray:
    inward = f.lower(f.lump((0, -57), (21, 6.0), (0, 3.4, -6.0)))
    return inward + f.lower(f.lump((0, -66), (20, 6), (0, 2.4, -1.2)))


def mouth_roll_upper(f: Face) -> np.ndarray:
    inward = f.upper(f.lump((0, -51), (21, 5.5), (0, -3.0, -5.4)))
    return inward + f.upper(f.lump((0, -44), (19, 6), (0, -2.4, -0.8)))


def mouth_shrug_lower(f: Face) -> np.ndarray:
    lip = f.lower(f.lump((0, -58), (20, 8), (0, 4.6, 2.6))) + f.upper(
        f.lump((0, -51), (17, 6), (0, 3.2, 1.0))
    )
    return lip + f.lump((0, -84), (17, 11), (0, 4.4, 0.6)) + f.lump_both((22, -56), (7, 7), (0, -1.6, 0))


def mouth_shrug_upper(f: Face) -> np.ndarray:
    return f.upper(f.lump((0, -49), (18, 9), (0, 3.8, 2.0))) + f.lower(
        f.lump((0, -57), (15, 5), (0, 3.0, 1.4))
    )


def mouth_press(f: Face) -> np.ndarray:
    upper = f.upper(f.lump((13, -50), (12, 5), (0, -1.8, -2.4)))
    lower = f.lower(f.lump((13, -58), (12, 6), (0, 2.4, -2.6)))
    return upper + lower + _corner(f, (1.8, 0.8, -1.6), (8, 8)) + f.lump((14, -72), (11, 8), (0, 1.6, 1.2))


def mouth_lower_down(f: Face) -> np.ndarray:
    return f.lower(f.lump((12, -58), (12, 11), (1.4, -7.0, -0.6))) + f.lump(
        (15, -76), (12, 9), (0.4, -1.8, 0.6)
    )


def mouth_upper_up(f: Face) -> np.ndarray:
    return f.upper(f.lump((12, -48), (11, 10), (0.8, 6.2, 0.4))) + f.lump((18, -32), (8, 12), (0.8, 2.6, 1.2))


def brow_down(f: Face) -> np.ndarray:
    return (
        f.lump((17, 41), (13, 9), (-3.0, -5.2, 1.0))
        + f.lump((38, 42), (13, 8), (-0.6, -3.0, 0))
        + f.lids(0.10, 0)
    )


def brow_inner_up(f: Face) -> np.ndarray:
    return f.lump_both((15, 41), (13, 11), (-0.6, 7.0, 0)) + f.lump((0, 66), (28, 12), (0, 2.2, 0.4))


def brow_outer_up(f: Face) -> np.ndarray:
    return (
        f.lump((42, 42), (14, 10), (0.4, 7.0, -0.8))
        + f.lump((40, 62), (18, 11), (0, 2.0, 0))
        + f.lids(-0.06, 0)
    )


def cheek_puff(f: Face) -> np.ndarray:
    cheeks = f.lump_both((37, -45), (20, 19), (8.5, 0, 9.0))
    return cheeks + f.lump((0, -52), (16, 16), (0, 0, 2.6)) + f.lump_both((21, -54), (9, 9), (-2.4, 0, 1.0))


def cheek_squint(f: Face) -> np.ndarray:
    return (
        f.lump((39, -10), (16, 13), (0.6, 5.0, 2.8))
        + f.lids(0.04, 1.7)
        + f.lump((30, -30), (12, 10), (0.6, 2.0, 0.6))
    )


def nose_sneer(f: Face) -> np.ndarray:
    wing = f.lump((12, -20), (8, 10), (1.4, 4.6, 0.4))
    bridge = f.lump((9, 8), (6, 10), (-0.6, -1.0, 1.4)) + f.lump((14, 30), (9, 9), (-1.0, -2.2, 0.8))
    return (
        wing
        + bridge
        + f.upper(f.lump((12, -44), (9, 9), (0.4, 2.8, 0.6)))
        + f.lump((20, -28), (7, 10), (0.5, 2.6, 1.0))
    )


def tongue_out(f: Face) -> np.ndarray:
    """The tongue slides out over the lower lip and hangs; the jaw opens as far as it must."""
    tongue = f.mesh.of("tongue")
    open_ = f.turn_jaw((np.radians(7.5), 0)) * (~tongue)[:, None]
    tip = np.where(tongue, f.mesh.marks["tip"], 0)
    out = smoothstep(0.25, 0.95, tip)
    move = np.stack(
        [0 * tip, -6.5 * smoothstep(0.2, 0.7, tip) - 9.0 * smoothstep(0.72, 1.0, tip), 32 * out], -1
    )
    flat = np.stack([-0.05 * f.p[:, 0], -0.35 * (f.p[:, 1] + 60), 0 * tip], -1) * out[:, None]
    lips = f.lower(f.lump((0, -57), (15, 8), (0, -2.2, 0.6))) + f.upper(
        f.lump((0, -50), (14, 7), (0, 1.0, 0))
    )
    return open_ + (move + flat) * tongue[:, None] + lips


BOTH: dict[str, Move] = {
    "jawForward": jaw_forward,
    "jawOpen": jaw_open,
    "mouthClose": mouth_close,
    "mouthFunnel": mouth_funnel,
    "mouthPucker": mouth_pucker,
    "mouthRollLower": mouth_roll_lower,
    "mouthRollUpper": mouth_roll_upper,
    "mouthShrugLower": mouth_shrug_lower,
    "mouthShrugUpper": mouth_shrug_upper,
    "browInnerUp": brow_inner_up,
    "cheekPuff": cheek_puff,
    "tongueOut": tongue_out,
}
LEFT: dict[str, Move] = {
    "eyeBlink": eye_blink,
    "eyeLookDown": look(0.40, -1.1, 0.0),
    "eyeLookIn": look(0.02, 0.0, -1.0),
    "eyeLookOut": look(0.02, 0.0, 1.0),
    "eyeLookUp": look(-0.27, 0.6, 0.0),
    "eyeSquint": eye_squint,
    "eyeWide": eye_wide,
    "jaw": jaw_left,
    "mouth": mouth_left,
    "mouthSmile": mouth_smile,
    "mouthFrown": mouth_frown,
    "mouthDimple": mouth_dimple,
    "mouthStretch": mouth_stretch,
    "mouthPress": mouth_press,
    "mouthLowerDown": mouth_lower_down,
    "mouthUpperUp": mouth_upper_up,
    "browDown": brow_down,
    "browOuterUp": brow_outer_up,
    "cheekSquint": cheek_squint,
    "noseSneer": nose_sneer,
}


def expression_modes(mesh: Mesh) -> tuple[np.ndarray, tuple[str, ...]]:
    """[E, V, 3] mm and the E names, in ARKit's spelling; pairs are exact mirror images."""
    face = read_face(mesh)
    modes, names = [], []
    for name, move in LEFT.items():
        left = face.line_mouth(move(face))
        modes += [left, face.mirror(left)]
        names += [f"{name}Left", f"{name}Right"]
    for name, move in BOTH.items():
        modes.append(face.line_mouth(move(face)))
        names.append(name)
    return np.stack(modes), tuple(names)
