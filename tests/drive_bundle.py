"""Bundles that stand on a real rig; their Gaussians are the tiny one's and do not matter here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tiny_bundle import tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.clip import Clip
from cap4d.rig.grid import build_grid, remesh
from cap4d.rig.head import HeadRig


def on_rig(rig: HeadRig, *, size: int = 128) -> Bundle:
    """The rig's mean person on a grid of `size`^2."""
    grid, mesh = build_grid(rig, size), rig.subject()
    zeros = np.zeros((2, 3), np.float32)
    idle = Clip(rig.name, 24.0, np.zeros((2, rig.n_expressions), np.float32), zeros, zeros, zeros)
    parts = dict(grid=grid, subject=remesh(mesh, grid), mesh_subject=mesh, idle=idle, rig_vertices=0)
    return replace(tiny_bundle(8, network=False), expression_range=rig.expression_range, **parts)
