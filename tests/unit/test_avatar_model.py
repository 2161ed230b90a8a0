"""How many Gaussians an avatar begins with, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

from tiny_avatar import GRID, tiny_rig

from cap4d.avatar.model import initial_counts
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
