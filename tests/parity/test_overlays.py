"""Overlays lie where the splats are, on every software driver of Mesa and with both renderers."""

from __future__ import annotations

import numpy as np
import pytest
from gl_drivers import DRIVERS, drawn_with
from gl_overlays import avatar, lone_faces, near

from cap4d.gaussians import Gaussians
from cap4d.render import render

PLAIN = [64, 128, 191, 255]  # what the overlays are drawn over


@pytest.fixture(scope="module", params=DRIVERS)
def found(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """What gl_overlays.py draws with one driver, in a process of its own."""
    return drawn_with(request.param, "gl_overlays.py", tmp_path_factory.mktemp("gl") / "overlays.npz")


@pytest.fixture(scope="module")
def vertices() -> np.ndarray:
    frame = avatar().idle.frame(2)
    return avatar().vertices(frame.expr, eye_rot=frame.eye_rot, neck_rot=frame.neck_rot)


def middle(weights: np.ndarray) -> np.ndarray:
    """(x, y) px of the centre of gravity; pixel centres at .5."""
    rows, columns = np.indices(weights.shape) + 0.5
    return np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()


def splat_middle(point: np.ndarray) -> np.ndarray:
    """(x, y) px of a small Gaussian at a point, as the CPU renderer draws it."""
    one = Gaussians(
        point[None].astype(np.float32),
        np.float32([[1, 0, 0, 0]]),
        np.full((1, 3), 1e-3, np.float32),
        np.float32([0.9]),
        np.zeros((1, 1, 3), np.float32),
    )
    return middle(render(one, near(), background=None).alpha)


def corners_of(index: int, vertices: np.ndarray) -> np.ndarray:
    """[3, 2] px."""
    return near().project(vertices[avatar().bundle.grid.faces[index]].astype(np.float64))[:, :2]


@pytest.mark.parametrize("samples", [0, 4])
def test_triangles_are_where_the_camera_projects_them(samples, found, vertices):
    """The middle and the area of each drawn alone, and each of its corners."""
    assert len(lone_faces()) >= 8
    for index in lone_faces():
        corners, covered = corners_of(index, vertices), found[f"face {index} {samples}"].astype(float)
        covered /= covered.max()
        assert np.abs(middle(covered) - corners.mean(0)).max() < (0.1 if samples else 0.4)  # rows on an edge
        area = 0.5 * abs(np.linalg.det(corners[1:] - corners[0]))
        assert covered.sum() == pytest.approx(area, rel=0.03 if samples else 0.07)
        out = (corners - corners.mean(0)) / np.linalg.norm(corners - corners.mean(0), axis=1)[:, None]
        for inside, beyond in zip(corners - (1.5 if samples else 3) * out, corners + 1.0 * out, strict=True):
            assert covered[int(inside[1]), int(inside[0])] > 0.2
            assert covered[int(beyond[1]), int(beyond[0])] == 0


def test_triangles_are_where_splats_are(found, vertices):
    for index in lone_faces():
        point = vertices[avatar().bundle.grid.faces[index]].astype(np.float64).mean(0)
        assert np.abs(splat_middle(point) - near().project(point)[:2]).max() < 0.05
        assert np.abs(middle(found[f"face {index} 4"].astype(float)) - splat_middle(point)).max() < 0.5


@pytest.mark.parametrize("kind", ["mesh", "wire"])
def test_lines_are_the_edges(kind, found, vertices):
    """Corners and middles of edges are on lines, to the pixel; the triangle's middle is not."""
    line, corners = found[f"lone {kind}"][..., 3], corners_of(lone_faces()[3], vertices)
    for x, y in [*corners, *(corners + np.roll(corners, 1, 0)) / 2]:
        assert line[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2].max() > 120
    x, y = corners.mean(0)
    assert line[int(y), int(x)] < 20 and line.max() > 200


def test_what_is_seen_from_inside_is_dim(found):
    outside, inside = found["lone mesh"][..., 3].astype(int), found["inside out"][..., 3].astype(int)
    lines = outside > 150
    assert np.abs(inside[lines] / outside[lines] - 0.25).max() < 0.1


def test_what_is_hidden_does_not_show(found):
    """The ball's far side has as many lines; they are not under those of the near side."""
    alpha = found["mesh"][..., 3]
    inner = alpha[80:120, 110:150]
    assert 0.1 < (inner > 100).mean() < 0.6 and (inner == 0).mean() > 0.1


@pytest.mark.parametrize("renderer", ["gl", "cpu"])
def test_nothing_shown_changes_nothing(renderer, found):
    assert (found[f"{renderer} "] == PLAIN).all()


@pytest.mark.parametrize("kinds", ["mesh", "uv", "density", "deformation", "density+deformation+uv+mesh"])
def test_both_renderers_get_the_same_overlay(kinds, found):
    gl, cpu = found[f"gl {kinds}"].astype(int), found[f"cpu {kinds}"].astype(int)
    changed = (gl != PLAIN).any(-1)
    assert 0.2 < changed.mean() < 1 and gl[changed].std(0)[:3].max() > 12
    assert (np.abs(gl - cpu).max(-1) > 12).mean() < 5e-3 and (gl[..., 3] == 255).all()


def test_surfaces_are_painted_where_the_surface_is(found):
    inside = found["outline"] > 0
    for kind in ("uv", "deformation"):
        assert ((found[f"gl {kind}"] != PLAIN).any(-1) == inside).mean() > 0.999


def test_counts_are_those_of_the_cpu_renderer(found):
    gl, cpu = found["gl counts"], found["cpu counts"]
    assert cpu.max() >= 8 and (gl != cpu).mean() < 5e-3 and np.abs(gl - cpu).max() <= 2
