"""A rig of a hundred vertices and a capture of it, small enough to fit in seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from cap4d.avatar.model import AvatarModel, Pose, create_avatar
from cap4d.camera import Camera, head_fixed
from cap4d.capture.capture import save_capture
from cap4d.capture.image import write_image
from cap4d.raster import rasterize
from cap4d.rig.grid import build_grid
from cap4d.rig.head import HeadRig

SIDE = 10
GRID = 16


def tiny_rig() -> HeadRig:
    """A bent 20 cm sheet: it bulges, it shears, its lower rows follow the neck."""
    v, u = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE), indexing="ij")
    template = np.stack([0.2 * (u - 0.5), 0.2 * (v - 0.5), -0.15 * (u - 0.5) ** 2], -1).reshape(-1, 3)
    index = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    bulge = np.zeros((SIDE, SIDE, 3))
    bulge[..., 2] = 0.03 * np.exp(-((u - 0.5) ** 2 + (v - 0.5) ** 2) / 0.05)
    shear = np.zeros((SIDE, SIDE, 3))
    shear[..., 0] = 0.02 * (v - 0.5)
    basis = np.stack([bulge, shear]).reshape(2, -1, 3)
    below = (v < 0.2).reshape(-1)
    return HeadRig(
        name="tiny",
        licence="CC0-1.0",
        template=template.astype(np.float32),
        faces=faces.astype(np.int32),
        uvs=np.stack([u, v], -1).reshape(-1, 2).astype(np.float32),
        uv_faces=faces.astype(np.int32),
        identity_basis=basis[1:].astype(np.float32),
        expression_basis=basis.astype(np.float32),
        expression_names=("bulge", "shear"),
        expression_range=np.array([[0, 1], [-1, 1]], np.float32),
        joint_names=("neck",),
        joint_drivers=("neck",),
        joints=np.array([[0, -0.1, -0.05]], np.float32),
        joints_identity=np.zeros((1, 1, 3), np.float32),
        joints_expression=np.zeros((2, 1, 3), np.float32),
        skin_weights=below[:, None].astype(np.float32),
        regions={"head": np.arange(SIDE * SIDE), "deformable": np.flatnonzero(~below)},
    )


def tiny_avatar(
    rig: HeadRig, *, gaussians: int = 600, sh_degree: int = 1, width: int | None = 4, seed: int = 0
) -> AvatarModel:
    """An avatar before its first step."""
    return create_avatar(
        rig,
        np.zeros(1, np.float32),
        grid=build_grid(rig, GRID),
        gaussians=gaussians,
        per_face=1,
        sh_degree=sh_degree,
        deformer_width=width,
        generator=torch.Generator().manual_seed(seed),
    )


def tiny_camera(size: int = 48) -> Camera:
    """A camera half a metre in front of the origin."""
    K = np.array([[1.8 * size, 0, size / 2], [0, 1.8 * size, size / 2], [0, 0, 1]])
    return Camera(K, np.eye(4), size, size)


def write_tiny_capture(path: Path, *, frames: int = 24, size: int = 48, seed: int = 0) -> None:
    """A film of a painted sheet that bulges and shears: exact parameters, images drawn by the splatting
    code.
    """
    rig, rng = tiny_rig(), np.random.default_rng(seed)
    truth = tiny_avatar(rig, gaussians=900, sh_degree=0, width=None, seed=seed + 1)
    centres = truth.subject.neutral[truth.faces].mean(1)[truth.binding]
    colours = 0.5 + 0.45 * torch.sin(centres @ torch.from_numpy(rng.normal(0, 60, (3, 3)).astype(np.float32)))
    truth.gaussians["sh_dc"].data = ((colours - 0.5) / 0.2820948)[:, None]
    truth.gaussians["opacity_logits"].data.fill_(3.0)
    t = np.linspace(0, 4 * np.pi, frames)
    expr = np.stack([0.5 - 0.5 * np.cos(t), np.sin(0.7 * t)], -1).astype(np.float32)
    rot = np.stack([0.1 * np.sin(t), 0.15 * np.cos(t), 0 * t], -1).astype(np.float32)
    tra = np.tile(np.float32([0, 0, -0.5]), (frames, 1))
    camera = tiny_camera(size)
    save_capture(
        path,
        rig_name=rig.name,
        shape=np.zeros(1),
        expr=expr,
        rot=rot,
        tra=tra,
        cameras={"cam0": camera},
        fps=10.0,
    )
    (path / "images" / "cam0").mkdir(parents=True)
    zero = torch.zeros(3)
    for i in range(frames):
        view = Camera(camera.K, head_fixed(camera.viewmat, rot[i], tra[i]), size, size)
        with torch.no_grad():
            p = truth.pose(Pose(torch.from_numpy(expr[i]), zero, zero, zero))
            image = rasterize(
                p.means, p.quats, p.scales, p.opacities, p.sh, camera=view, background=(1.0, 1.0, 1.0)
            )
        write_image(path / "images" / "cam0" / f"{i:05d}.png", image.rgb.clamp(0, 1).numpy())
