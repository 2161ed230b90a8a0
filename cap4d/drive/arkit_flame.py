"""Apple's 52 on FLAME, whose expressions have no names: each shape is solved for on the avatar's own basis.

What the shapes are is known as offsets of FLAME's vertices (`arkit_on_flame.npz`: ICT-FaceKit's, MIT licence,
taken over by track/arkit_targets.py). No table of coefficients is stored: a basis differs from edition to
edition, and from the released system's to FLAME's own (its blink), so the fit is made when an avatar is
loaded, against the basis it carries: whatever basis that is, what it can show of a shape it shows.
`ArkitMap.error_mm` says what it cannot.

The fit is ridge least squares: `PATCHES` times the mean square miss, in units of `MISS` of the shape's own
size, plus the square of the expressions (which FLAME scales to unit variance). Where the rig has a jaw
(`flame2020`, `flame2023`), `jaw_rot` opens it and expressions add what skinning lacks; in the no_jaw edition
they open it alone. The released system's `blink` shuts both eyes: half of it is Apple's left one, half the
right.

An edition's neutral face may have its lips apart; Apple's has not. `rest` then says how far Apple's jaw is
open in it, so that weights of zero close them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from cap4d.atomic import replacing
from cap4d.bundle.bundle import Bundle
from cap4d.drive.arkit import COLUMN, NAMES, ArkitMap
from cap4d.rig.flame import EYES_FROM
from cap4d.rig.grid import UvGrid
from cap4d.rig.head import Subject
from cap4d.rig.npz import checked, checked_indices, read_npz
from cap4d.rotation import axis_angle_to_rotmat

TARGETS = "arkit_on_flame.npz"
MISS, PATCHES = 0.35, 300.0  # of a shape's own size; as many independent pieces a face has
TINY = 1e-12  # m^2
JAW_SHAPES = ("jawOpen", "jawLeft", "jawRight")  # which turn the jaw; `jawForward` slides it
JAW_ROUNDS, JAW_STEP = 8, 1e-4  # rad of the finite differences
OWN = 0.01  # share of a point's motion that eyes or the mouth's inside may have
LIPS_TOUCH = 0.0025  # m between the lips' inner landmarks when they are closed
MOVES = 1e-4  # m: points that a shape moves less are not counted in its error
MAX_REST = 0.6
SHOWN = 0.5  # share of the lips' parting that a basis must have, to close a mouth with it


@dataclass(frozen=True, eq=False)
class Targets:
    """The shapes on FLAME's mesh.

    Args:
        vertices: int[P] FLAME's vertices that have a counterpart.
        offsets: float[52, P, 3] m at a weight of 1.
        lips: int[L, 2] vertices inside the upper and the lower lip, one below the other.
    """

    vertices: np.ndarray
    offsets: np.ndarray
    lips: np.ndarray


def write_targets(path: Path, targets: Targets) -> None:
    """Offsets as whole numbers of -127 to 127 per shape: its motion to half a per cent."""
    scale = np.abs(targets.offsets).max((1, 2)) / 127
    whole = np.round(targets.offsets / np.maximum(scale, 1e-12)[:, None, None]).astype(np.int8)
    arrays = {
        "vertices": targets.vertices.astype(np.int32),
        "offsets": whole,
        "scale": scale.astype(np.float32),
        "lips": targets.lips.astype(np.int32),
        "names": np.array(NAMES),
        "source": np.array(
            "ICT-FaceKit Light, (c) 2020 USC Institute for Creative Technologies, MIT licence"
        ),
    }
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def read_targets(path: Path) -> Targets:
    """Raises: DataError, where the file is not what `write_targets` writes."""
    arrays = read_npz(path)
    count = len(checked(path, "vertices", arrays.get("vertices"), kind="index", shape=(None,)))
    whole = checked(path, "offsets", arrays.get("offsets"), kind="index", shape=(len(NAMES), count, 3))
    scale = checked(path, "scale", arrays.get("scale"), kind="float", shape=(len(NAMES),))
    vertices = checked_indices(path, "vertices", arrays["vertices"], shape=(count,), below=EYES_FROM)
    lips = checked_indices(path, "lips", arrays.get("lips"), shape=(None, 2), below=EYES_FROM)
    return Targets(vertices, whole.astype(np.float32) * scale[:, None, None].astype(np.float32), lips)


@cache
def own_targets() -> Targets:
    """The package's."""
    with as_file(files("cap4d.drive") / TARGETS) as path:
        return read_targets(path)


def arkit_on_flame(bundle: Bundle, targets: Targets | None = None) -> ArkitMap:
    """The map of an avatar on any edition of FLAME. Takes a fifth of a second."""
    targets = targets or own_targets()
    subject, wanted = _where_known(bundle, targets)
    expr, jaw_rot = _solve(subject, wanted)
    shown = _shown(subject, expr, jaw_rot)
    rest = np.zeros(len(NAMES), np.float32)
    rest[COLUMN["jawOpen"]] = _lips_apart(
        bundle, targets, *(m[:, COLUMN["jawOpen"]] for m in (expr, jaw_rot))
    )
    return ArkitMap(
        bundle.rig_name,
        expr.astype(np.float32),
        jaw_rot.astype(np.float32),
        tuple(name for name, offsets in zip(NAMES, wanted, strict=True) if not offsets.any()),
        np.array([_error_mm(a, b) for a, b in zip(shown, wanted, strict=True)], np.float32),
        rest,
    )


def _lips_apart(bundle: Bundle, targets: Targets, expr: np.ndarray, jaw_rot: np.ndarray) -> float:
    """How far Apple's jaw is open in the avatar's neutral face: 0 where its lips touch, or where what is to
    be `jawOpen`, `expr` [E] and `jaw_rot` [3], does not part them.
    """
    grid, subject = bundle.grid, bundle.subject
    points = [[_grid_point(grid, vertex) for vertex in pair] for pair in targets.lips.tolist()]
    seen = [pair for pair in points if None not in pair]
    if not seen:
        return 0.0
    upper, lower = np.array(seen).T
    gap = lambda height: float(np.median(height[upper] - height[lower]))  # noqa: E731
    rise = np.zeros(max(bundle.rig_vertices, EYES_FROM), np.float32)
    rise[targets.vertices] = targets.offsets[COLUMN["jawOpen"], :, 1]
    wanted = gap((rise[grid.vertices] * grid.bary).sum(1))
    neutral = subject.pose(0 * expr, jaw_rot=0 * jaw_rot)[:, 1]
    if gap(subject.pose(expr, jaw_rot=jaw_rot)[:, 1] - neutral) < SHOWN * wanted:
        return 0.0
    return float(np.clip((gap(neutral) - LIPS_TOUCH) / wanted, 0, MAX_REST))


def _where_known(bundle: Bundle, targets: Targets) -> tuple[Subject, np.ndarray]:
    """The avatar at the grid points that mix known vertices alone; the shapes there, float64[52, P, 3] m."""
    row = np.full(max(bundle.rig_vertices, EYES_FROM), -1)
    row[targets.vertices] = np.arange(len(targets.vertices))
    corners, subject = row[bundle.grid.vertices], bundle.subject
    elsewhere = [j for j, driver in enumerate(subject.joint_drivers) if driver in ("eyes", "expr")]
    known = (corners >= 0).all(1) & (subject.skin_weights[:, elsewhere].sum(1) < OWN)
    bary = bundle.grid.bary[known].astype(np.float64)
    wanted = np.einsum("pk,npkc->npc", bary, targets.offsets[:, corners[known]].astype(np.float64))
    return _points_of(subject, known), wanted


def _solve(subject: Subject, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """expr [E, 52], jaw_rot [3, 52]: the jaw as far as it alone explains a shape, expressions for what is
    left.
    """
    jaw_rot = np.zeros((3, len(NAMES)))
    if "jaw" in subject.joint_drivers and not subject.rig_name.endswith("no_jaw"):
        for name in JAW_SHAPES:
            jaw_rot[:, COLUMN[name]] = _solve_jaw(subject, wanted[COLUMN[name]])
    left = (wanted - [_turned(subject, turn) for turn in jaw_rot.T]).reshape(len(NAMES), -1)
    basis = subject.expression_basis.reshape(len(subject.expression_names), -1)
    miss = MISS * np.sqrt((left**2).mean(1))
    spread, modes = np.linalg.eigh(basis @ basis.T)
    ridge = np.maximum(miss**2 * basis.shape[1] / PATCHES, TINY)
    expr = modes @ ((modes.T @ (basis @ left.T)) / (spread[:, None] + ridge))
    if "blink" in subject.expression_names:  # shuts both eyes: each of Apple's does half of that
        own = np.array([name == "blink" for name in subject.expression_names])
        for name in ("eyeBlinkLeft", "eyeBlinkRight"):
            expr[:, COLUMN[name]] = 0.5 * own
    return expr, jaw_rot


def _solve_jaw(subject: Subject, wanted: np.ndarray) -> np.ndarray:
    """[3] rad, the turn of the jaw that comes nearest to offsets [P, 3]; by Gauss and Newton."""
    turn = np.zeros(3)
    for _ in range(JAW_ROUNDS):
        here = _turned(subject, turn)
        slope = np.stack([_turned(subject, turn + step) - here for step in JAW_STEP * np.eye(3)]) / JAW_STEP
        slope = slope.reshape(3, -1)
        turn = turn + np.linalg.solve(slope @ slope.T, slope @ (wanted - here).reshape(-1))
    return turn


def _turned(subject: Subject, turn: np.ndarray) -> np.ndarray:
    """[P, 3] m from neutral, the jaw turned by `turn` [3] rad."""
    if not turn.any():
        return np.zeros_like(subject.neutral)
    joint = subject.joint_drivers.index("jaw")
    rotation = axis_angle_to_rotmat(turn) - np.eye(3)
    moved = subject.skin_weights[:, joint, None] * ((subject.neutral - subject.joints[joint]) @ rotation.T)
    if subject.pose_basis is not None:
        moved = moved + np.tensordot(rotation.reshape(9), subject.pose_basis[9 * joint : 9 * joint + 9], 1)
    return moved


def _shown(subject: Subject, expr: np.ndarray, jaw_rot: np.ndarray) -> np.ndarray:
    """[52, P, 3] m, what the shapes look like as solved."""
    basis = subject.expression_basis.reshape(len(expr), -1)
    return (expr.T @ basis).reshape(len(NAMES), -1, 3) + [_turned(subject, turn) for turn in jaw_rot.T]


def _points_of(subject: Subject, mask: np.ndarray) -> Subject:
    """The subject on some of its points, float64, without what is constant."""
    of = lambda array: np.ascontiguousarray(array[..., mask, :], np.float64)  # noqa: E731
    return replace(
        subject,
        neutral=of(subject.neutral),
        expression_basis=of(subject.expression_basis),
        skin_weights=of(subject.skin_weights),
        pose_basis=None if subject.pose_basis is None else of(subject.pose_basis),
        pose_offset=None,
    )


def _grid_point(grid: UvGrid, vertex: int) -> int | None:
    """The grid's point that is nearest to one of the mesh's vertices, if any mixes it."""
    share = (grid.bary * (grid.vertices == vertex)).sum(1)
    best = int(share.argmax())
    return best if share[best] > 0 else None


def _error_mm(shown: np.ndarray, wanted: np.ndarray) -> float:
    """Root mean square over the points that either moves."""
    moves = np.maximum((shown**2).sum(-1), (wanted**2).sum(-1)) > MOVES**2
    return 1e3 * float(np.sqrt(((shown - wanted)[moves] ** 2).sum(-1).mean())) if moves.any() else 0.0
