"""The mesh rasteriser against direct barycentric arithmetic, and its degenerate cases."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d import _core
from cap4d.camera import orbit_camera
from cap4d.mesh import rasterize_mesh, shade, vertex_normals

CAMERA = orbit_camera(
    yaw_deg=0, pitch_deg=0, distance=1, target=np.zeros(3), fov_y_deg=30, width=64, height=48
)
# one triangle facing the camera (which looks along +z, y down), counter-clockwise seen from it
TRIANGLE = np.array([[-0.1, 0.1, 0.0], [0.1, 0.1, 0.05], [0.0, -0.1, -0.1]])
FACES = np.array([[0, 1, 2]], np.int32)


def test_interpolated_positions_lie_on_the_pixel_rays() -> None:
    fragments = rasterize_mesh(TRIANGLE, FACES, CAMERA)
    assert 100 < fragments.hit.sum() < 1000
    points = fragments.interpolate(TRIANGLE, FACES)[fragments.hit]
    rows, columns = np.nonzero(fragments.hit)
    np.testing.assert_allclose(CAMERA.project(points)[:, :2], np.stack([columns, rows], 1) + 0.5, atol=1e-9)


def test_the_nearer_triangle_wins_and_back_faces_can_be_culled() -> None:
    both = np.concatenate([TRIANGLE + [0, 0, 0.3], TRIANGLE])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    seen = rasterize_mesh(both, faces, CAMERA)
    centre = seen.face[24, 32]
    assert centre == 1
    flipped = faces[:, ::-1].copy()
    assert not rasterize_mesh(both, flipped, CAMERA, cull_back=True).hit.any()
    assert rasterize_mesh(both, faces, CAMERA, cull_back=True).hit.any()


def test_equal_depths_go_to_the_smaller_index() -> None:
    faces = np.array([[0, 1, 2], [0, 1, 2]], np.int32)
    assert set(np.unique(rasterize_mesh(TRIANGLE, faces, CAMERA).face)) == {-1, 0}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_non_finite_vertices_draw_nothing_and_harm_nothing(bad: float) -> None:
    vertices = np.concatenate([TRIANGLE, np.full((1, 3), bad)])
    faces = np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    with np.errstate(all="ignore"):
        fragments = rasterize_mesh(vertices, faces, CAMERA)
    assert set(np.unique(fragments.face)) <= {-1, 0}


def test_behind_the_camera_and_zero_area_draw_nothing() -> None:
    assert not rasterize_mesh(TRIANGLE - [0, 0, 2], FACES, CAMERA).hit.any()
    assert not rasterize_mesh(TRIANGLE[[0, 0, 1]], FACES, CAMERA).hit.any()


def test_wrong_indices_are_refused() -> None:
    with pytest.raises(ValueError, match="index 3 is out of range"):
        _core.rasterize_mesh(np.zeros((3, 3)), np.array([[0, 1, 3]], np.int32), 4, 4)
    with pytest.raises(ValueError, match="size"):
        _core.rasterize_mesh(np.zeros((3, 3)), FACES, 0, 4)


def test_shade_is_opaque_inside_and_clear_outside() -> None:
    image = shade(TRIANGLE, FACES, CAMERA, colors=np.full((3, 3), 0.5))
    assert image.shape == (48, 64, 4) and image.dtype == np.float32
    assert image[24, 32, 3] == 1 and image[0, 0, 3] == 0 and (image[0, 0, :3] == 1).all()
    assert np.isfinite(image).all()


def test_normals_face_outwards() -> None:
    np.testing.assert_allclose(np.linalg.norm(vertex_normals(TRIANGLE, FACES), axis=1), 1)
    assert (vertex_normals(TRIANGLE, FACES)[:, 2] < 0).all()
