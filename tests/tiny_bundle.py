"""A complete bundle made of almost nothing: a ball that talks, for tests of players and files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.bundle import Bundle
from cap4d.camera import orbit_camera
from cap4d.drive.clip import Clip
from cap4d.gaussians import SH_COUNTS
from cap4d.player.deformer import Deformer
from cap4d.player.png import encode_png
from cap4d.rig.grid import UvGrid, mesh_grid
from cap4d.rig.head import Subject

RIG_NAME = "tiny"
EXPRESSIONS = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft", "browInnerUp")
JOINTS = ("neck", "eyes", "expr")
RADIUS = 0.1  # m


def tiny_grid(size: int = 16) -> UvGrid:
    """A grid whose corners are off the surface; each grid vertex mixes three of `size`^2 mesh vertices."""
    at = np.arange(size) + 0.5
    inside = (at[:, None] / size - 0.5) ** 2 + (at / size - 0.5) ** 2 < 0.33
    pixels = np.argwhere(inside).astype(np.int16)
    index = np.full((size, size), -1, np.int64)
    index[inside] = np.arange(len(pixels))
    faces = []
    for c in range(size - 1):
        for r in range(size - 1):
            for triangle in (((r, c), (r + 1, c), (r + 1, c + 1)), ((r, c), (r + 1, c + 1), (r, c + 1))):
                corners = [index[at] for at in triangle]
                if min(corners) >= 0:
                    faces.append(corners)
    rows, columns = pixels.astype(np.int64).T
    mesh = lambda r, c: np.minimum(r, size - 1) * size + np.minimum(c, size - 1)  # noqa: E731
    vertices = np.stack([mesh(rows, columns), mesh(rows + 1, columns), mesh(rows, columns + 1)], -1)
    bary = np.tile(np.float32([0.8, 0.1, 0.1]), (len(pixels), 1))
    deformable = rows > size // 3
    return UvGrid(size, pixels, np.array(faces, np.int32), deformable, vertices.astype(np.int32), bary)


def tiny_mesh(size: int = 16, *, seed: int = 0) -> Subject:
    """A ball of `size`^2 vertices, seen from the front at the middle of the UV square; rig axes."""
    rng = np.random.default_rng(seed)
    v, u = (((np.indices((size, size)) + 0.5) / size) * 2 - 1).reshape(2, -1)
    yaw, pitch = 0.8 * np.pi * u, -0.45 * np.pi * v
    ball = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], -1)
    waves = rng.normal(size=(len(EXPRESSIONS), 2, 3))
    basis = [
        np.sin(np.outer(u, 3 * a[0]) + np.outer(v, 3 * b[0])) * a + np.cos(2 * v)[:, None] * b
        for a, b in waves
    ]
    skin = np.zeros((size * size, len(JOINTS)))
    skin[:, 0] = np.clip(v - 0.6, 0, 1)  # the lower rim bends
    skin[:, 1] = np.exp(-((u - 0.2) ** 2 + (v + 0.2) ** 2) / 0.02)
    skin[:, 2] = np.exp(-(u**2 + (v - 0.4) ** 2) / 0.05) * (1 - skin[:, 1]) * (1 - skin[:, 0])
    joints = np.array([[0, -0.08, 0], [0.02, 0.02, 0.06], [0, -0.03, 0.02]])
    arrays = {
        "neutral": RADIUS * ball,
        "expression_basis": 0.004 * np.array(basis),
        "joints": joints,
        "joints_expression": 1e-4 * rng.normal(size=(len(EXPRESSIONS), len(JOINTS), 3)),
        "skin_weights": skin,
        "expr_rotation": 0.1 * rng.normal(size=(len(EXPRESSIONS), 3)),
        "pose_basis": 1e-4 * rng.normal(size=(9 * len(JOINTS), size * size, 3)),
        "pose_offset": 1e-4 * rng.normal(size=(size * size, 3)),
    }
    return Subject(
        RIG_NAME, EXPRESSIONS, joint_drivers=JOINTS, **{k: a.astype(np.float32) for k, a in arrays.items()}
    )


def tiny_network(grid: UvGrid, *, seed: int = 0) -> bytes:
    """ONNX: a convolution of the offsets, scaled and masked as a real deformer is."""
    import onnx
    from onnx import numpy_helper
    from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info

    rng, size = np.random.default_rng(seed), grid.size
    mask = grid.to_map(np.ones((len(grid), 1), np.float32))[None]
    constants = {
        "scale": np.float32(1 / 0.0108),
        "weight": 0.1 * rng.normal(size=(8, 3, 5, 5)).astype(np.float32),
        "bias": 0.1 * rng.normal(size=8).astype(np.float32),
        "weight2": 0.1 * rng.normal(size=(3, 8, 5, 5)).astype(np.float32),
        "unscale": np.float32(0.0108) * mask,
    }
    nodes = [
        make_node("Mul", ["offsets", "scale"], ["scaled"]),
        make_node("Conv", ["scaled", "weight", "bias"], ["hidden"], pads=[2, 2, 2, 2]),
        make_node("Tanh", ["hidden"], ["active"]),
        make_node("Conv", ["active", "weight2"], ["raw"], pads=[2, 2, 2, 2]),
        make_node("Mul", ["raw", "unscale"], ["deformation"]),
    ]
    values = [
        make_tensor_value_info(n, onnx.TensorProto.FLOAT, [1, 3, size, size])
        for n in ("offsets", "deformation")
    ]
    weights = [
        numpy_helper.from_array(np.ascontiguousarray(array), name) for name, array in constants.items()
    ]
    graph = make_graph(nodes, "tiny", values[:1], values[1:], weights)
    model = make_model(graph, opset_imports=[make_opsetid("", 18)], ir_version=8)
    return model.SerializeToString(deterministic=True)


def tiny_clip(frames: int = 12, *, seed: int = 0) -> Clip:
    """Smooth expressions, gaze and neck, at 24 fps."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / frames
    wave = lambda n: np.sin(2 * np.pi * (t[:, None] + rng.uniform(size=n))).astype(np.float32)  # noqa: E731
    return Clip(
        RIG_NAME,
        24.0,
        wave(len(EXPRESSIONS)),
        0.2 * wave(3),
        0.1 * wave(3),
        np.zeros((frames, 3), np.float32),
    )


def tiny_bundle(
    size: int = 16,
    *,
    gaussians: int = 3,
    sh_degree: int = 1,
    seed: int = 0,
    network: bool = True,
    mesh: bool = True,
) -> Bundle:
    """A playable bundle.

    Args:
        size: Pixels a side of the grid.
        gaussians: Per face.
        network: With a deformation network (needs the `onnx` package).
        mesh: Knows the subject on the mesh as well (larger than the grid here, so the file holds the grid's).
    """
    rng = np.random.default_rng(seed)
    grid, ball = tiny_grid(size), tiny_mesh(size, seed=seed)
    subject = ball.resample(grid.vertices, grid.bary)
    deform_neutral, onnx = np.zeros((len(grid), 3), np.float32), None
    if network:
        onnx = tiny_network(grid, seed=seed)
        deform_neutral = grid.from_map(Deformer(onnx, size=size)(np.zeros((3, size, size), np.float32)))
    n, s = gaussians * len(grid.faces), {degree: count for count, degree in SH_COUNTS.items()}[sh_degree]
    sh = 0.05 * rng.normal(size=(n, s, 3))
    binding = np.repeat(np.arange(len(grid.faces)), gaussians)
    tint = np.array([0.9, 0.65, 0.55]) - 0.25 * (grid.pixels[grid.faces[binding, 0], 0] % 4 == 0)[:, None]
    sh[:, 0] += (tint - 0.5) / 0.28209479177387814
    camera = orbit_camera(
        yaw_deg=10, pitch_deg=5, distance=0.7, target=np.zeros(3), fov_y_deg=25, width=64, height=64
    )
    return Bundle(
        rig_licence="CC0-1.0",
        expression_range=np.tile(np.float32([0, 1]), (len(EXPRESSIONS), 1)),
        grid=grid,
        subject=subject,
        deform_neutral=np.ascontiguousarray(deform_neutral),
        deform_onnx=onnx,
        means=rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32),
        quats=rng.normal([2, 0, 0, 0], 1, (n, 4)).astype(np.float32),
        log_scales=rng.uniform(-1.5, -0.5, (n, 3)).astype(np.float32),
        opacity_logits=rng.uniform(0, 4, n).astype(np.float32),
        sh=sh.astype(np.float32),
        binding=binding.astype(np.int32),
        camera=camera,
        idle=tiny_clip(seed=seed),
        preview=encode_png(np.full((8, 8, 3), 200, np.uint8)),
        mesh_subject=ball if mesh else None,
    )


def tiny_bundle_on_mesh(size: int = 16, *, gaussians: int = 3, seed: int = 0) -> Bundle:
    """A playable bundle whose Gaussians ride on the ball's own triangles, without a network."""
    whole, ball = tiny_bundle(size, gaussians=1, seed=seed, network=False), tiny_mesh(size, seed=seed)
    at = np.arange(size * size).reshape(size, size)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    binding = np.repeat(np.arange(len(faces), dtype=np.int32), gaussians)
    taken = np.resize(np.arange(len(whole)), len(binding))
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    return replace(
        whole,
        **{name: getattr(whole, name)[taken] for name in names},
        grid=mesh_grid(faces, len(ball.neutral)),
        subject=ball,
        mesh_subject=ball,
        deform_neutral=np.zeros_like(ball.neutral),
        binding=binding,
    )
