"""Captures of the tiny rig by several cameras, drawn by the splatting code: for protocols."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tiny_avatar import tiny_avatar, tiny_rig

from cap4d.avatar.model import Pose
from cap4d.camera import Camera, look_at
from cap4d.capture.capture import save_capture
from cap4d.capture.image import write_image
from cap4d.raster import rasterize

YAWS = (-40, -20, 0, 20, 40)


def write_tiny_ring(path: Path, *, frames: int = 4, size: int = 32, seed: int = 0) -> None:
    """A painted sheet that bulges, seen by five cameras around it; another seed, another paint."""
    rig, rng = tiny_rig(), np.random.default_rng(seed)
    truth = tiny_avatar(rig, gaussians=900, sh_degree=0, width=None, seed=seed + 1)
    centres = truth.subject.neutral[truth.faces].mean(1)[truth.binding]
    colours = 0.5 + 0.45 * torch.sin(centres @ torch.from_numpy(rng.normal(0, 60, (3, 3)).astype(np.float32)))
    truth.gaussians["sh_dc"].data = ((colours - 0.5) / 0.2820948)[:, None]
    truth.gaussians["opacity_logits"].data.fill_(3.0)
    K = np.array([[1.8 * size, 0, size / 2], [0, 1.8 * size, size / 2], [0, 0, 1]])
    cameras = {f"cam{i}": _camera(K, yaw, size) for i, yaw in enumerate(YAWS)}
    expr = np.stack([np.linspace(0, 1, frames), np.zeros(frames)], -1).astype(np.float32)
    zeros = np.zeros((frames, 3), np.float32)
    save_capture(path, rig_name=rig.name, shape=np.zeros(1), expr=expr, rot=zeros, tra=zeros, cameras=cameras)
    for name, camera in cameras.items():
        (path / "images" / name).mkdir(parents=True)
        for t in range(frames):
            image = _draw(truth, expr[t], camera)
            write_image(path / "images" / name / f"{t:05d}.png", image)


def _camera(K: np.ndarray, yaw: float, size: int) -> Camera:
    away = np.array([np.sin(np.radians(yaw)), 0, -np.cos(np.radians(yaw))])
    return Camera(K, look_at(0.5 * away, np.zeros(3)), size, size)


def _draw(avatar, expr: np.ndarray, camera: Camera) -> np.ndarray:
    zero = torch.zeros(3)
    with torch.no_grad():
        p = avatar.pose(Pose(torch.from_numpy(expr), zero, zero, zero))
        image = rasterize(
            p.means, p.quats, p.scales, p.opacities, p.sh, camera=camera, background=(1.0, 1.0, 1.0)
        )
    return image.rgb.clamp(0, 1).numpy()
