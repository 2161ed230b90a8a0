"""What `cap4d drive` sends: a file as packets, in its own rig's terms unless an avatar stands between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.arkit import NAMES
from cap4d.drive.clip import Clip
from cap4d.drive.fit import read_sequence
from cap4d.drive.livelink import pose_of_angles
from cap4d.drive.livelink_csv import read_values
from cap4d.drive.packet import Packet
from cap4d.drive.vertices import VERTEX_FPS, expected_vertices, read_vertices
from cap4d.errors import ArgumentError

Form = Literal["expr", "arkit", "vertices"]
FORMS: tuple[Form, ...] = get_args(Form)
OWN_FORMS: dict[str, Form] = {".npz": "expr", ".npy": "vertices", ".csv": "arkit", ".cap4d": "expr"}
SOURCES = "a fit.npz, vertices in an .npy, a Live Link Face recording (.csv), an avatar.cap4d, or -"


@dataclass(frozen=True, eq=False)
class Recording:
    """`count` frames at `fps`; `packet(i, t)` is frame i at t seconds of the sender's clock."""

    form: Form
    fps: float
    count: int
    packet: Callable[[int, float], Packet]


def open_recording(
    spec: str,
    *,
    form: Form | None = None,
    avatar: Path | None = None,
    template: Path | None = None,
    fps: float | None = None,
) -> Recording:
    """Opens a file to send.

    Args:
        spec: `*.npz`, `*.npy` or `*.csv` as of `open_source`, or `*.cap4d`: its idle clip.
        form: How it is said; None: as the file has it.
        avatar: Whose rig translates into another form. An `*.cap4d` is its own.
        template: Neutral vertices of an `.npy`, to translate it; as of `open_source`.
        fps: Frames per second, whatever the file says.
    Raises:
        ArgumentError: No such kind of file, a form that it cannot take, or a template where none is used.
        DataError: A file is not sound, or of another rig.
    """
    path = Path(spec)
    own = OWN_FORMS.get(path.suffix)
    if own is None:
        raise ArgumentError(f"drive: expected {SOURCES}, got {spec}")
    if form in (None, own):
        if template is not None:
            raise ArgumentError("template: goes with vertices that are sent as something else (--as)")
        return _untranslated(path, fps)
    if avatar is None and path.suffix != ".cap4d":
        raise ArgumentError(
            f"as: {spec} holds {own}: to send {form}, name an avatar of its rig with --avatar"
        )
    return _translated(path, form, avatar, template, fps)


def _untranslated(path: Path, fps: float | None) -> Recording:
    if path.suffix == ".npz":
        return clip_recording(read_sequence(path, fps=fps))
    if path.suffix == ".npy":
        return vertex_recording(read_vertices(path, None), fps or VERTEX_FPS)
    if path.suffix == ".csv":
        return livelink_recording(*read_values(path, fps=fps))
    return clip_recording(_idle(path, fps)[1])


def _translated(
    path: Path, form: Form, avatar: Path | None, template: Path | None, fps: float | None
) -> Recording:
    from cap4d.bundle.reader import read_bundle
    from cap4d.drive.source import open_source

    if avatar is None:
        bundle, clip = _idle(path, fps)
    else:
        bundle = read_bundle(avatar)
        clip = open_source(str(path), bundle, template=template, fps=fps)
    if form == "expr":
        return clip_recording(clip)
    return arkit_recording(clip, bundle) if form == "arkit" else posed_recording(clip, bundle)


def _idle(path: Path, fps: float | None) -> tuple[Bundle, Clip]:
    from cap4d.bundle.reader import read_bundle
    from cap4d.drive.source import open_source

    bundle = read_bundle(path)
    return bundle, open_source(None, bundle, fps=fps)


def clip_recording(clip: Clip) -> Recording:
    """Expressions; a rotation that is zero throughout is left out, as what the source does not know."""
    turns = _turns(clip)

    def packet(i: int, t: float) -> Packet:
        return Packet(t, clip.rig_name, clip.expr[i], **{name: value[i] for name, value in turns.items()})

    return Recording("expr", clip.fps, len(clip), packet)


def arkit_recording(clip: Clip, bundle: Bundle) -> Recording:
    """Expressions of a rig with ARKit's names, as ARKit's weights.

    Raises:
        ArgumentError: The rig has other names.
    """
    weights, turns = clip.expr @ arkit_from_expr(bundle.subject.expression_names), _turns(clip)

    def packet(i: int, t: float) -> Packet:
        pose = {name: value[i] for name, value in turns.items()}
        return Packet(t, arkit=np.clip(weights[i], 0, 1), **pose)

    return Recording("arkit", clip.fps, len(clip), packet)


def arkit_from_expr(names: tuple[str, ...]) -> np.ndarray:
    """float32[E, 52]: each ARKit weight is its namesake, or the mean of a left and a right one.

    Raises:
        ArgumentError: Fewer than half of ARKit's names are there.
    """
    columns = {name.replace("_L", "Left").replace("_R", "Right"): i for i, name in enumerate(names)}
    matrix = np.zeros((len(names), len(NAMES)), np.float32)
    for j, name in enumerate(NAMES):
        parts = [columns[n] for n in (name, f"{name}Left", f"{name}Right") if n in columns]
        matrix[parts, j] = 1 / max(len(parts), 1)
    found = int(matrix.any(0).sum())
    if 2 * found < len(NAMES):
        raise ArgumentError(
            f"as: expected a rig with ARKit's {len(NAMES)} names, got one with {found} of them"
        )
    return matrix


def livelink_recording(rate: float, values: np.ndarray) -> Recording:
    """float32[T, 61] as of `livelink_csv.read_values`, as they are."""
    weights, pose = values[:, : len(NAMES)], pose_of_angles(values[:, len(NAMES) :])

    def packet(i: int, t: float) -> Packet:
        return Packet(t, arkit=weights[i], **{name: value[i] for name, value in pose.items()})

    return Recording("arkit", rate, len(values), packet)


def vertex_recording(vertices: np.ndarray, fps: float) -> Recording:
    """float32[T, V, 3] m, as they are."""
    return Recording("vertices", fps, len(vertices), lambda i, t: Packet(t, vertices=vertices[i]))


def posed_recording(clip: Clip, bundle: Bundle) -> Recording:
    """The avatar's own mesh in each frame; gaze and jaw are in it, neck and head pose beside it."""
    subject = bundle.mesh_subject
    if subject is None:
        raise ArgumentError("as: expected an avatar that holds its rig's mesh, to send vertices")
    count, turns = expected_vertices(bundle), _turns(clip)
    beside = {name: value for name, value in turns.items() if name not in ("eye_rot", "jaw_rot")}

    def packet(i: int, t: float) -> Packet:
        posed = subject.pose(clip.expr[i], eye_rot=clip.eye_rot[i], jaw_rot=clip.jaw_rot[i])[:count]
        return Packet(t, vertices=posed, **{name: value[i] for name, value in beside.items()})

    return Recording("vertices", clip.fps, len(clip), packet)


def _turns(clip: Clip) -> dict[str, np.ndarray]:
    turns = {name: getattr(clip, name) for name in ("eye_rot", "neck_rot", "jaw_rot")}
    turns = {name: value for name, value in turns.items() if value.any()}
    return turns | {name: getattr(clip, name) for name in ("rot", "tra") if getattr(clip, name) is not None}
