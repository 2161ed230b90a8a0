"""Synthetic captures: a rig seen by known cameras with known expressions, rendered from its coloured mesh.

Ground truth for tests and material for the demo: what fit.npz says is exactly what the images show. The light
is fixed to the head, as the avatar's colours are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.camera import Camera, look_at, opencv_from_rig
from cap4d.capture.capture import save_capture
from cap4d.capture.image import write_image
from cap4d.errors import ArgumentError
from cap4d.mesh import rasterize_mesh, vertex_normals
from cap4d.rig.head import HeadRig, Subject
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.synth.idle import VISEMES, expression_vector, look_weights, speaks_arkit

DISTANCE, FOV_DEG = 1.1, 17.5  # m and degrees of every camera
TARGET = np.array(
    [0.0, 0.015, 0.0]
)  # m, OpenCV axes: the middle of what the cameras see, a little below the eyes
SUPERSAMPLE = 2
NEUTRAL_COLOR = (0.80, 0.62, 0.54)  # of rigs without colours
# Lights in the head's frame (OpenCV axes: -y is up, -z in front of the face): direction to the light,
# strength.
LIGHTS = (((-0.45, -0.75, -1.0), 0.42), ((0.9, -0.15, -0.7), 0.17), ((0.3, -0.5, 1.0), 0.12))
SKY, GROUND = 0.60, 0.40  # light without direction, from above and from below


@dataclass(frozen=True, eq=False)
class Performance:
    """T frames of a head: expr [T, E], eye_rot, neck_rot, rot, tra [T, 3] (rig axes, rad, m)."""

    expr: np.ndarray
    eye_rot: np.ndarray
    neck_rot: np.ndarray
    rot: np.ndarray
    tra: np.ndarray


def synthesize(
    rig: HeadRig,
    output: Path,
    *,
    identity: int | None = None,
    views: int = 8,
    frames: int = 48,
    size: int = 256,
    seed: int = 0,
    deviations: float = 1.0,
) -> None:
    """Writes a capture of `rig` in the FlowFace layout.

    Args:
        rig: Any rig; drawn in its colours, or in one skin colour.
        output: The capture's folder, made if need be.
        identity: The number of a made-up person with painted skin, filmed from the front (see studio.py);
            None is the rig's neutral identity in plain colours.
        views: Cameras; without `identity` every fourth one sees the head from behind, in a quarter of the
            frames.
        frames: The first one is neutral.
        size: Pixels a side.
        seed: Same seed, same capture.
        deviations: Of a person: how far they move otherwise than the rig's model.
    Raises:
        ArgumentError: A number out of its range; with `identity`, no UVs or a folder that is not new.
    """
    check_sizes(identity=identity, views=views, frames=frames, size=size, seed=seed, deviations=deviations)
    if identity is not None:
        from cap4d.synth.studio import film

        kind = {"views": views, "frames": frames, "size": size, "seed": seed, "deviations": deviations}
        film(rig, output, identity=identity, **kind)
        return
    output, rng = Path(output), np.random.default_rng(seed)
    subject = rig.subject()
    cameras, behind = _cameras(views, size, rng)
    performance = perform(rig, frames, rng)
    valid = np.ones((views, frames), bool)
    valid[behind] = np.arange(frames) % 4 == 0
    save_performance(rig, output, np.zeros(rig.n_identity, np.float32), cameras, performance, valid)
    for t in range(frames):
        vertices = head_vertices(subject, performance, t)
        shades = _shades(rig, vertices)
        for c, (name, camera) in enumerate(cameras.items()):
            if valid[c, t]:
                rgb, matte = _draw(world_vertices(vertices, performance, t), rig.faces, shades, camera)
                write_image(output / "images" / name / f"{t:05d}.png", rgb)
                write_image(output / "bg" / name / f"{t:04d}.png", matte)


def check_sizes(
    *, identity: int | None, views: int, frames: int, size: int, seed: int, deviations: float
) -> None:
    """Raises ArgumentError where a number is out of its range."""
    counts = {"views": (views, 1, 256), "frames": (frames, 1, 100_000), "size": (size, 1, 4096)}
    seeds = {"identity": (identity or 0, 0, 2**63 - 1), "seed": (seed, 0, 2**63 - 1)}
    for name, (value, low, high) in {**counts, **seeds}.items():
        if not low <= value <= high:
            raise ArgumentError(f"{name}: expected {low} to {high}, got {value}")
    if not 0 <= deviations <= 4:
        raise ArgumentError(f"deviations: expected 0 to 4, got {deviations}")


def head_vertices(subject: Subject, performance: Performance, t: int) -> np.ndarray:
    """[V, 3] frame t in the head-fixed frame, OpenCV axes."""
    posed = subject.pose(
        performance.expr[t], eye_rot=performance.eye_rot[t], neck_rot=performance.neck_rot[t]
    )
    return opencv_from_rig(posed.astype(np.float64))


def world_vertices(vertices: np.ndarray, performance: Performance, t: int) -> np.ndarray:
    """Head-fixed -> world, both OpenCV axes (fact 9)."""
    rotmat = axis_angle_to_rotmat(performance.rot[t].astype(np.float64))
    return opencv_from_rig(opencv_from_rig(vertices) @ rotmat.T + performance.tra[t])


def _cameras(views: int, size: int, rng: np.random.Generator) -> tuple[dict[str, Camera], np.ndarray]:
    """Cameras about the head and bool[views] which of them see it from behind."""
    behind = np.arange(views) % 4 == 3
    front = int((~behind).sum())
    yaw = np.zeros(views)
    yaw[~behind] = np.linspace(-60, 60, front) if front > 1 else 0
    yaw[behind] = (np.array([1, -1])[np.arange(behind.sum()) % 2] * rng.uniform(105, 165, behind.sum())) % 360
    pitch = rng.uniform(-20, 20, views) * np.where(behind, 0.5, 1)
    pitch[np.argmin(np.abs(yaw))] = 0
    focal = 0.5 * size / np.tan(np.radians(FOV_DEG) / 2)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    cameras = {}
    for i in range(views):
        y, p = np.radians([yaw[i], pitch[i]])
        away = np.array([np.sin(y) * np.cos(p), -np.sin(p), -np.cos(y) * np.cos(p)])
        cameras[f"cam{i:02d}"] = Camera(K, look_at(TARGET + DISTANCE * away, TARGET), size, size)
    return cameras, behind


def perform(rig: HeadRig, frames: int, rng: np.random.Generator) -> Performance:
    """Expressions, glances and turns of the head; the first frame is at rest."""
    gaze = np.concatenate([rng.normal(0, np.radians([5.0, 9.0]), (frames, 2)), np.zeros((frames, 1))], 1)
    poses = {
        "eye_rot": np.clip(gaze, -0.35, 0.35),
        "neck_rot": rng.normal(0, np.radians([3.0, 4.0, 2.0]), (frames, 3)),
        "rot": rng.normal(0, np.radians([4.0, 7.0, 2.5]), (frames, 3)),
        "tra": rng.normal(0, [0.006, 0.004, 0.006], (frames, 3)),
    }
    for value in poses.values():
        value[0] = 0
    expr = (
        _named_expressions(rig, poses["eye_rot"], rng)
        if speaks_arkit(rig)
        else _random_expressions(rig, frames, rng)
    )
    expr[0] = 0
    poses = {name: value.astype(np.float32) for name, value in poses.items()}
    return Performance(expr.astype(np.float32), **poses)


def _named_expressions(rig: HeadRig, gaze: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mouth shapes of speech in every second frame, a few single expressions in the others; blinks and lids
    in all.
    """
    n, lids = len(rig.expression_names), ("eyeblink", "eyelook", "mouthclose")
    single = [i for i, name in enumerate(rig.expression_names) if not name.lower().startswith(lids)]
    low, high = rig.expression_range.T
    order = np.concatenate([rng.permutation(single) for _ in range(1 + len(gaze) * 3 // len(single))])
    expr = np.zeros((len(gaze), n))
    for t in range(len(gaze)):
        if t % 2:
            shape = VISEMES[rng.integers(len(VISEMES))]
            expr[t] += rng.uniform(0.6, 1.8) * expression_vector(rig, shape)
        chosen = order[3 * t : 3 * t + (1 if t % 2 else 3)]
        expr[t, chosen] += rng.uniform(0.25, 0.9, len(chosen))
        blink = rng.choice([0.0, 0.0, 0.0, 0.5, 1.0])
        expr[t] += expression_vector(rig, {"eyeBlink": blink * rng.uniform(0.8, 1)})
        expr[t] += (1 - blink) * expression_vector(rig, look_weights(gaze[t]))
    return np.clip(expr, low, high)


def _random_expressions(rig: HeadRig, frames: int, rng: np.random.Generator) -> np.ndarray:
    low, high = rig.expression_range.T
    n = rig.n_expressions
    return np.clip(rng.normal(0, 0.25 / (1 + np.arange(n) / 10), (frames, n)) * (high - low), low, high)


def save_performance(
    rig: HeadRig,
    output: Path,
    shape: np.ndarray,
    cameras: dict[str, Camera],
    performance: Performance,
    valid: np.ndarray,
) -> None:
    """Everything but the images: their folders, fit.npz and the list of views (`valid` bool[C, T])."""
    for name in cameras:
        (output / "images" / name).mkdir(parents=True, exist_ok=True)
        (output / "bg" / name).mkdir(parents=True, exist_ok=True)
    save_capture(
        output,
        rig_name=rig.name,
        shape=shape,
        expr=performance.expr,
        rot=performance.rot,
        tra=performance.tra,
        eye_rot=performance.eye_rot,
        neck_rot=performance.neck_rot,
        cameras=cameras,
        valid=valid,
        references=[
            (name, t) for c, name in enumerate(cameras) for t in range(len(performance.expr)) if valid[c, t]
        ],
    )


def _shades(rig: HeadRig, vertices: np.ndarray) -> np.ndarray:
    """[V, 3] sRGB of every vertex under the lights, in the head's frame."""
    normals = vertex_normals(vertices, rig.faces)
    light = GROUND + (SKY - GROUND) * (0.5 - 0.5 * normals[:, 1])
    for direction, strength in LIGHTS:
        facing = normals @ (np.array(direction) / np.linalg.norm(direction))
        light = light + strength * np.clip((facing + 0.25) / 1.25, 0, 1) ** 1.3
    colors = np.tile(NEUTRAL_COLOR, (len(vertices), 1)) if rig.colors is None else rig.colors
    colors = colors * (1 + _mottle(rig)[:, None])
    shine = np.zeros(len(vertices))
    if "eyes" in rig.regions:
        shine[rig.regions["eyes"]] = _glint(normals[rig.regions["eyes"]])
    return np.clip(colors * light[:, None] + shine[:, None], 0, 1)


def _mottle(rig: HeadRig) -> np.ndarray:
    """[V] a few per cent of tone that varies over the skin, from its place on the neutral head."""
    p = rig.template.astype(np.float64) * 1e3
    waves = ([0.05, 0.04, 0.03], [-0.06, 0.07, 0.04], [0.09, -0.05, 0.08])
    return sum(0.010 * np.sin(p @ np.array(wave) + phase) for phase, wave in enumerate(waves))


def _glint(normals: np.ndarray) -> np.ndarray:
    """The key light's reflection for a viewer in front of the face (fixed, so that it does not wander with
    the view).
    """
    half = np.array(LIGHTS[0][0]) / np.linalg.norm(LIGHTS[0][0]) + [0, 0, -1]
    return 0.8 * np.clip(normals @ (half / np.linalg.norm(half)), 0, 1) ** 160


def _draw(
    vertices: np.ndarray, faces: np.ndarray, shades: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Straight sRGB [H, W, 3] and coverage [H, W] of the mesh."""
    n = SUPERSAMPLE
    fragments = rasterize_mesh(vertices, faces, camera.resized(camera.width * n, camera.height * n))
    lit = np.zeros((*fragments.face.shape, 3))
    corners = shades[faces[fragments.face[fragments.hit]]]
    lit[fragments.hit] = np.einsum("pk,pkc->pc", fragments.bary[fragments.hit], corners)
    boxes = (camera.height, n, camera.width, n)
    matte = fragments.hit.reshape(boxes).mean((1, 3))
    rgb = lit.reshape(*boxes, 3).mean((1, 3)) / np.maximum(matte, 1e-6)[..., None]
    return np.where(matte[..., None] > 0, rgb, 1), matte
