"""A rig with its own colours as an avatar: one Gaussian a triangle, no network, nothing fitted."""

from __future__ import annotations

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.camera import orbit_camera
from cap4d.drive.clip import Clip
from cap4d.drive.landmark_head import SH_0
from cap4d.rig.grid import build_grid, remesh
from cap4d.rig.head import HeadRig


def painted_bundle(rig: HeadRig, shape: np.ndarray | None = None) -> Bundle:
    """The rig's head of identity `shape`, in memory."""
    grid, zeros = build_grid(rig), np.zeros((1, 3), np.float32)
    on_grid = remesh(rig, grid)
    count = len(grid.faces)
    rgb = on_grid.colors[grid.faces].mean(1) if on_grid.colors is not None else np.full((count, 3), 0.7)
    return Bundle(
        rig_licence=rig.licence,
        expression_range=rig.expression_range,
        grid=grid,
        subject=remesh(rig.subject(shape), grid),
        deform_neutral=np.zeros((len(grid), 3), np.float32),
        deform_onnx=None,
        means=np.zeros((count, 3), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), -6, np.float32),
        opacity_logits=np.full(count, 4, np.float32),
        sh=((rgb - 0.5) / SH_0)[:, None].astype(np.float32),
        binding=np.arange(count, dtype=np.int32),
        camera=orbit_camera(
            yaw_deg=0, pitch_deg=0, distance=1, target=np.zeros(3), fov_y_deg=25, width=256, height=256
        ),
        idle=Clip(rig.name, 30.0, np.zeros((1, rig.n_expressions), np.float32), zeros, zeros, zeros),
        preview=b"",
    )
