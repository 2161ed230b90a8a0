"""Avatars of GaussianAvatars (Qian et al. 2024): `point_cloud.ply` and `flame_param.npz` -> `.cap4d`.

Gaussians on the triangles of FLAME with a jaw and added teeth, and the parameters of the sequence they were
fitted to, which becomes the idle clip. What changes on the way:

- Directions of the harmonics are the world's there and the head's here: they agree in the mean pose of the
  sequence.
- Here one rotation turns both eyes: the mean of the two there.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.schema import COUNTS, IDLE, TENSORS
from cap4d.bundle.writer import write_bundle
from cap4d.camera import Camera, opencv_from_rig, orbit_camera
from cap4d.drive.clip import Clip
from cap4d.errors import ArgumentError, DataError
from cap4d.harmonics import rotate_sh
from cap4d.player.avatar import Avatar
from cap4d.player.png import encode_png
from cap4d.rig.flame import (
    EDITIONS_WITH_JAW,
    N_FILE_IDENTITY,
    N_VERTICES,
    RELEASED_RIG,
    FlameModel,
    read_flame,
)
from cap4d.rig.grid import mesh_grid
from cap4d.rig.head import Subject
from cap4d.rig.npz import checked_float32, read_npz
from cap4d.transfer.flame_chain import (
    N_EXPRESSIONS,
    HeadMotion,
    head_motion,
    head_subject,
    mean_pose,
    person,
    relative_to,
)
from cap4d.transfer.flame_teeth import with_teeth
from cap4d.transfer.gaussian_ply import BoundGaussians, read_gaussian_ply

log = logging.getLogger(__name__)

LICENCE = "LicenseRef-FLAME"
PARAMS = "flame_param.npz"
FPS = 25.0  # the files say none
MIN_FPS, MAX_FPS = 0.1, 1000.0  # of an idle clip
USEFUL = (-3.0, 3.0)  # standard deviations of FLAME's expressions
MAX_PARAMS_BYTES = 1 << 30  # unpacked; an offset a frame and vertex that is zero makes most of a file
SEQUENCES = {
    "expr": N_EXPRESSIONS,
    "rotation": 3,
    "neck_pose": 3,
    "jaw_pose": 3,
    "eyes_pose": 6,
    "translation": 3,
}
LIMITS = {
    "shape": 100.0,
    "static_offset": 1.0,
    "expr": TENSORS[IDLE]["expr"].high,
    "translation": TENSORS[IDLE]["tra"].high / 2,
    **dict.fromkeys(("rotation", "neck_pose", "jaw_pose", "eyes_pose"), TENSORS[IDLE]["neck_rot"].high),
}
"""Largest numbers of the parameters, in their own units."""
VIEW = {"yaw_deg": 0, "pitch_deg": 0, "distance": 1.0, "fov_y_deg": 25, "width": 512, "height": 512}


@dataclass(frozen=True, eq=False)
class FlameSequence:
    """A `flame_param.npz`, checked; float64, T frames, V vertices.

    Args:
        shape: [300].
        static_offset: [V, 3] m.
        expr: [T, 100].
        rotation, neck_pose, jaw_pose: [T, 3] axis-angle, rad.
        eyes_pose: [T, 6] rad, the left eye first.
        translation: [T, 3] m.
    """

    shape: np.ndarray
    static_offset: np.ndarray
    expr: np.ndarray
    rotation: np.ndarray
    neck_pose: np.ndarray
    jaw_pose: np.ndarray
    eyes_pose: np.ndarray
    translation: np.ndarray


def import_gaussian_avatars(
    ply: Path, output: Path, *, flame: Path, params: Path | None = None, fps: float = FPS
) -> None:
    """Writes `output`, a `.cap4d` file.

    Args:
        ply: `point_cloud.ply`.
        params: `flame_param.npz`; None: that beside it.
        flame: FLAME 2020 or 2023 with a jaw, the pickle that the avatar was fitted with.
        fps: Of the sequence.
    Raises:
        DataError: Something is not sound.
        ArgumentError: An impossible rate.
    """
    if not MIN_FPS <= fps <= MAX_FPS:
        raise ArgumentError(f"fps: expected {MIN_FPS:g} to {MAX_FPS:g}, got {fps:g}")
    params = ply.with_name(PARAMS) if params is None else params
    model = with_teeth(read_edition(flame))
    sequence = read_sequence(params, vertices=len(model.template))
    gaussians = read_gaussian_ply(ply, faces=len(model.faces))
    log.info("%s: %d Gaussians; %s: %d frames", ply, len(gaussians), params, len(sequence.expr))
    stem = flame.stem
    bundle = make_bundle(gaussians, sequence, model, name=EDITIONS_WITH_JAW.get(stem, stem), fps=fps)
    write_bundle(bundle, output)
    log.info("%s: %.1f MB", output, output.stat().st_size / 1e6)


def read_edition(path: Path) -> FlameModel:
    """FLAME as the published code takes it.

    Raises:
        DataError: It is not sound, or has no jaw.
    """
    if path.stem == RELEASED_RIG:
        raise DataError(path, "model", expected="FLAME 2020 or 2023 with a jaw", found=RELEASED_RIG)
    flame = read_flame(path)
    components, wanted = flame.shapedirs.shape[2], N_FILE_IDENTITY + N_EXPRESSIONS
    if components < wanted:
        raise DataError(path, "shapedirs", expected=f"at least {wanted} components", found=components)
    return flame


def read_sequence(path: Path, *, vertices: int) -> FlameSequence:
    """Reads and checks parameters.

    Args:
        vertices: Of FLAME with teeth.
    Raises:
        DataError: Naming the array. A `dynamic_offset` must be zero: it has no place in a `.cap4d` file.
    """
    names = ("shape", "static_offset", "dynamic_offset", *SEQUENCES)
    arrays = read_npz(path, names=names, max_bytes=MAX_PARAMS_BYTES)
    frames = len(checked_float32(path, "expr", arrays.get("expr"), shape=(None, N_EXPRESSIONS)))
    low, high = COUNTS["idle_frames"]
    if not low <= frames <= high:
        raise DataError(path, "expr", expected=f"{low} to {high} frames", found=frames)
    found = {
        name: checked_float32(path, name, arrays.get(name), shape=(frames, width))
        for name, width in SEQUENCES.items()
    }
    found["shape"] = checked_float32(path, "shape", arrays.get("shape"), shape=(N_FILE_IDENTITY,))
    found["static_offset"] = _static_offset(path, arrays.get("static_offset"), vertices)
    for name, value in found.items():
        if np.abs(value).max() > LIMITS[name]:
            expected = f"numbers within {LIMITS[name]:g}"
            raise DataError(path, name, expected=expected, found=np.abs(value).max())
    moving = arrays.get("dynamic_offset")
    if moving is not None and (moving.dtype.kind not in "fiu" or moving.any()):
        expected = "zeros: an offset that changes with the frame has no place in an avatar"
        raise DataError(path, "dynamic_offset", expected=expected, found="another number")
    return FlameSequence(**{name: value.astype(np.float64) for name, value in found.items()})


def make_bundle(
    gaussians: BoundGaussians, sequence: FlameSequence, flame: FlameModel, *, name: str, fps: float
) -> Bundle:
    """The avatar on FLAME's own triangles.

    Args:
        flame: With teeth.
        name: Of the rig.
    """
    neutral = person(flame, sequence.shape, sequence.static_offset)
    subject = head_subject(flame, neutral, name)
    driven = {key: getattr(sequence, key) for key in ("expr", "rotation", "neck_pose", "translation")}
    motion = head_motion(flame, neutral, **driven)
    pose = mean_pose(motion)
    bundle = Bundle(
        rig_licence=LICENCE,
        expression_range=np.tile(np.float32(USEFUL), (N_EXPRESSIONS, 1)),
        grid=mesh_grid(flame.faces, len(neutral)),
        subject=subject,
        deform_neutral=np.zeros_like(subject.neutral),
        deform_onnx=None,
        means=gaussians.means,
        quats=gaussians.quats,
        log_scales=gaussians.log_scales,
        opacity_logits=gaussians.opacity_logits,
        sh=rotate_sh(gaussians.sh, opencv_from_rig(pose[0]).T),  # from the world to the head
        binding=gaussians.binding,
        camera=_front_view(flame, subject),
        idle=_clip(sequence, motion, pose, name=name, fps=fps),
        preview=encode_png(np.zeros((1, 1, 3), np.uint8)),
        mesh_subject=subject,
    )
    return replace(bundle, preview=_preview(bundle))


def _static_offset(path: Path, offset: np.ndarray | None, vertices: int) -> np.ndarray:
    """float32[V, 3]; a file may leave it out, hold it as a batch of one, or not know the teeth."""
    if offset is None:
        return np.zeros((vertices, 3), np.float32)
    if offset.ndim == 3 and len(offset) == 1:
        offset = offset[0]
    known = N_VERTICES if offset.shape[:1] == (N_VERTICES,) else vertices
    checked = checked_float32(path, "static_offset", offset, shape=(known, 3))
    return np.concatenate([checked, np.zeros((vertices - known, 3), np.float32)])


def _clip(
    sequence: FlameSequence,
    motion: HeadMotion,
    pose: tuple[np.ndarray, np.ndarray],
    *,
    name: str,
    fps: float,
) -> Clip:
    """The sequence in a world in which the head stands upright at the origin on average."""
    left, right = sequence.eyes_pose[:, :3], sequence.eyes_pose[:, 3:]
    apart = np.degrees(np.linalg.norm(left - right, axis=1).max())
    if apart > 0.1:
        log.info("eyes: turned alike, the mean of both, which are up to %.1f degrees apart", apart)
    turns = {"eye_rot": (left + right) / 2, "neck_rot": -sequence.neck_pose, "jaw_rot": sequence.jaw_pose}
    rot, tra = relative_to(pose, motion)
    expr = sequence.expr.astype(np.float32)
    return Clip(name, fps, expr, **{k: v.astype(np.float32) for k, v in turns.items()}, rot=rot, tra=tra)


def _front_view(flame: FlameModel, subject: Subject) -> Camera:
    """From in front of the middle of the head, the neck left aside."""
    head = opencv_from_rig(subject.neutral[flame.weights[:, 0] < 0.5])
    return orbit_camera(target=(head.min(0) + head.max(0)) / 2, **VIEW)


def _preview(bundle: Bundle) -> bytes:
    """PNG of the calmest frame, on white."""
    frame = bundle.idle.frame(int(np.abs(bundle.idle.expr).sum(1).argmin()))
    return encode_png(Avatar(bundle).draw(frame, bundle.camera, background=(1.0, 1.0, 1.0))[..., :3])
