"""The UV grid: pixel conventions, face order, masks, maps; the released system's counts for FLAME (facts
16-19).
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cap4d.errors import ArgumentError
from cap4d.rig.flame import read_assets
from cap4d.rig.grid import build_grid, mesh_grid, own_triangles, remesh
from cap4d.rig.obj import read_obj, triangulate

SIZE = 8


def flat_rig(uvs, uv_faces, deformable=()):
    """What build_grid reads of a rig; the surface is the texture itself, at z = 0."""
    uvs = np.float32(uvs)
    return SimpleNamespace(
        name="flat",
        template=np.concatenate([uvs, 0 * uvs[:, :1]], 1),
        faces=np.int32(uv_faces),
        uvs=uvs,
        uv_faces=np.int32(uv_faces),
        regions={"deformable": np.array(deformable, int)},
    )


@pytest.fixture
def square():
    return flat_rig([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]], deformable=[0, 1, 2])


def positions(rig, grid):
    return (rig.template[grid.vertices] * grid.bary[..., None]).sum(1)


def test_pixels_lie_where_fact_16_puts_them(square):
    grid = build_grid(square, SIZE)
    np.testing.assert_array_equal(np.argwhere(grid.valid), grid.pixels)
    row, column = grid.pixels.T
    expected = np.stack([1 - (column + 0.5) / SIZE, (row + 0.5) / SIZE], -1)
    np.testing.assert_allclose(positions(square, grid)[:, :2], expected, atol=1e-6)
    assert (np.diff(row.astype(int) * SIZE + column) == 1).all()  # scan order, all valid


def test_face_order_of_fact_18(square):
    grid = build_grid(square, SIZE)
    assert len(grid.faces) == 2 * (SIZE - 1) ** 2

    def at(row, column):
        return row * SIZE + column

    first = [[at(0, 0), at(1, 0), at(1, 1)], [at(0, 0), at(1, 1), at(0, 1)], [at(1, 0), at(2, 0), at(2, 1)]]
    np.testing.assert_array_equal(grid.faces[:3], first)
    next_column = [at(0, 1), at(1, 1), at(1, 2)]
    np.testing.assert_array_equal(grid.faces[2 * (SIZE - 1)], next_column)


def test_grid_faces_look_the_way_the_surface_looks(square):
    grid = build_grid(square, SIZE)
    corner = positions(square, grid)[grid.faces]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (normals[:, 2] > 0).all()


def test_deformable_needs_three_deformable_corners(square):
    grid = build_grid(square, SIZE)
    both = np.isin(grid.vertices, [0, 1, 2]).all(1)
    np.testing.assert_array_equal(grid.deformable, both)
    assert 0 < both.sum() < len(grid)


def test_mirrored_triangles_are_not_seen(square):
    mirrored = flat_rig(square.uvs, square.faces[:, ::-1])
    assert len(build_grid(mirrored, SIZE)) == 0


def test_no_face_spans_two_islands():
    left = [[0, 0], [0.45, 0], [0.45, 1], [0, 1]]
    right = [[0.46, 0], [1, 0], [1, 1], [0.46, 1]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    grid = build_grid(flat_rig(left + right, faces), SIZE)
    assert len(grid) == SIZE * SIZE  # no pixel lies between them, yet
    sides = grid.vertices[grid.faces].max((1, 2)) // 4, grid.vertices[grid.faces].min((1, 2)) // 4
    np.testing.assert_array_equal(*sides)
    assert len(grid.faces) == 2 * (SIZE - 1) ** 2 - 2 * (SIZE - 1)


def test_maps_there_and_back(square):
    half = flat_rig(square.uvs, square.faces[:1])
    grid = build_grid(half, SIZE)
    values = np.random.default_rng(0).normal(size=(2, len(grid), 3)).astype(np.float32)
    image = grid.to_map(values)
    assert image.shape == (2, 3, SIZE, SIZE) and image.dtype == np.float32
    np.testing.assert_array_equal(grid.from_map(image), values)
    row, column = grid.pixels[5]
    np.testing.assert_array_equal(image[:, :, row, column], values[:, 5])
    assert np.count_nonzero(np.abs(image).sum((0, 1))) == len(grid)  # zero elsewhere


def test_maps_of_tensors_carry_gradients(square):
    torch = pytest.importorskip("torch")
    grid = build_grid(square, SIZE)
    values = torch.randn(len(grid), 3, dtype=torch.float64, requires_grad=True)
    image = grid.to_map(values)
    np.testing.assert_array_equal(image.detach().numpy(), grid.to_map(values.detach().numpy()))
    (grid.from_map(image) * 2).sum().backward()
    assert (values.grad == 2).all()


def test_refusals(square):
    with pytest.raises(ArgumentError, match="size"):
        build_grid(square, 1)
    with pytest.raises(ArgumentError, match="needs a rig with UVs"):
        build_grid(flat_rig(np.zeros((0, 2)), np.zeros((0, 3))), SIZE)


def test_released_counts_on_the_cap4d_template(shared):
    """All counts are the released system's exactly: in float64 with closed edges no pixel centre is a tie."""
    template = shared / "flame" / "cap4d_assets" / "cap4d_avatar_template.obj"
    mesh = read_obj(template)
    faces, uv_faces = triangulate(mesh.faces, mesh.uv_faces)
    assets = read_assets(template.parent, faces[:9976])
    a, b, c = (mesh.uvs[uv_faces[:, corner]] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    assert [(area > 0).sum(), (area < 0).sum(), (area == 0).sum()] == [10614, 8, 34]  # fact 16
    rig = flat_rig(mesh.uvs, uv_faces)
    rig.template, rig.faces, rig.regions = mesh.vertices, faces, {"deformable": assets.deformable}
    grid = build_grid(rig, 128)
    assert (len(grid), len(grid.faces), grid.deformable.sum()) == (14425, 28120, 8424)  # facts 17-19
    corner = positions(rig, grid)[grid.faces]
    edges = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=-1)
    doubled = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(doubled, axis=1).sum() / 2
    assert abs(edges.max() - 22.6e-3) < 0.1e-3 and abs(area - 0.180) < 0.0005  # fact 18


def test_a_remeshed_subject_is_the_remeshed_mesh(builtin_rig):
    """Blendshapes commute with remeshing; see the property tests for joints."""
    grid = build_grid(builtin_rig, 64)
    expr = np.random.default_rng(0).uniform(0, 1, builtin_rig.n_expressions).astype(np.float32)
    shape = np.random.default_rng(1).normal(size=builtin_rig.n_identity).astype(np.float32)
    on_grid = remesh(builtin_rig, grid).subject(shape).pose(expr)
    mesh = builtin_rig.subject(shape).pose(expr)
    np.testing.assert_allclose(on_grid, (mesh[grid.vertices] * grid.bary[..., None]).sum(1), atol=2e-6)
    also = remesh(builtin_rig.subject(shape), grid).pose(expr)
    np.testing.assert_allclose(also, on_grid, atol=2e-6)


# The rig's own triangles ------------------------------------------------------------


def test_own_triangles_stand_on_the_rigs_vertices(square):
    grid = own_triangles(square)
    assert grid.is_mesh and not build_grid(square, SIZE).is_mesh
    assert len(grid) == 4 and not grid.deformable.any() and len(grid.pixels) == 0
    np.testing.assert_array_equal(grid.faces, square.faces)
    np.testing.assert_array_equal(positions(square, grid), square.template)  # to the bit


def test_own_triangles_leave_out_what_has_no_area_and_second_sides():
    corners = [[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0], [0, 0]]
    faces = [
        [0, 1, 2],
        [0, 1, 1],  # a seam
        [0, 4, 1],  # three in a line
        [2, 1, 0],  # the other side of the first
        [1, 2, 0],  # the first again
        [0, 5, 2],  # two vertices in one place
        [0, 2, 3],
    ]
    np.testing.assert_array_equal(own_triangles(flat_rig(corners, faces)).faces, [[0, 1, 2], [0, 2, 3]])
    with pytest.raises(ArgumentError, match="triangles that have an area, got 2"):
        own_triangles(flat_rig(corners, faces[1:3]))


def test_own_triangles_need_no_uvs(square):
    square.uvs, square.uv_faces = square.uvs[:0], square.uv_faces[:0]
    assert len(own_triangles(square).faces) == 2


def test_a_mesh_has_no_map(square):
    grid = mesh_grid(square.faces, 4)
    with pytest.raises(ValueError, match="shape"):
        grid.to_map(np.ones((4, 3), np.float32))
