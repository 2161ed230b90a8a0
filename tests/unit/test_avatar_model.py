"""How many Gaussians an avatar begins with, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from tiny_avatar import GRID, tiny_avatar, tiny_rig

from cap4d.avatar.model import Deformation, Pose, initial_counts
from cap4d.rig.grid import build_grid, own_triangles


@pytest.mark.parametrize("gaussians", [10, 162, 200, 1000])
def test_own_triangles_begin_within_the_budget_in_proportion_to_area(gaussians: int) -> None:
    rig = tiny_rig()
    rig = replace(rig, template=rig.template * np.float32([1, 1, 3]))  # the sides of the sheet grow
    grid = own_triangles(rig)
    counts = initial_counts(rig, grid, gaussians=gaussians, per_face=1)
    assert counts.min() >= 1
    assert 0.9 * gaussians < counts.sum() <= max(gaussians, len(grid.faces))
    corners = rig.template[grid.faces].astype(float)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (np.diff(counts[np.argsort(areas, kind="stable")]) >= 0).all()


def test_a_uv_grid_keeps_the_floor_of_fact_29() -> None:
    rig = tiny_rig()
    grid = build_grid(rig, GRID)
    counts = initial_counts(rig, grid, gaussians=100, per_face=2)
    assert (counts == 2).all() and counts.sum() > 100


def test_what_the_released_recipe_measures_of_a_deformation():
    """Its roughness on the map that moves the surface, its size on the Gaussians that ride on it."""
    rig = tiny_rig()
    model = tiny_avatar(rig)
    generator = torch.Generator().manual_seed(0)
    maps = 1e-3 * torch.randn(2, 3, GRID, GRID, generator=generator)
    moved, neutral = model.grid.from_map(maps)
    deformation = Deformation(maps, torch.where(model.deformable, moved, neutral), neutral)
    moving = model.moving_map(deformation)
    assert torch.equal(model.grid.from_map(moving), deformation.moved)
    off_surface = model.grid.to_map(torch.ones(len(model.grid), 1))[0] == 0
    assert torch.equal(moving[:, off_surface], maps[1][:, off_surface])
    pose = Pose(torch.tensor([0.5, -0.2]), *torch.zeros(3, 3))
    posed = model.pose(pose)
    assert torch.equal(model.riding(posed.surface + posed.deformation.moved)[0], posed.means)
