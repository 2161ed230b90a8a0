"""Reading Wavefront OBJ."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d.errors import DataError
from cap4d.rig.obj import read_obj, read_obj_vertices, triangulate

GOOD = """# a comment
o thing
v 0 0 0
v 1 0 0 0.5 0.5 0.5
v 1 1 0
v 0 1 1e-3
vt 0 0
vt 1 0 0
vt 1 1
vn 0 0 1
usemtl skin
f 1/1/1 2/2/1 3/3/1
f 1/1 2/2 3/3 4/1
"""


def write(tmp_path, text):
    (tmp_path / "mesh.obj").write_text(text)
    return tmp_path / "mesh.obj"


def test_vertices_textures_triangles_and_quads(tmp_path):
    mesh = read_obj(write(tmp_path, GOOD))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1e-3]])
    np.testing.assert_array_equal(mesh.uvs, [[0, 0], [1, 0], [1, 1]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2, -1], [0, 1, 2, 3]])
    np.testing.assert_array_equal(mesh.uv_faces, [[0, 1, 2, -1], [0, 1, 2, 0]])
    np.testing.assert_array_equal(read_obj_vertices(tmp_path / "mesh.obj"), mesh.vertices)


def test_windows_line_ends(tmp_path):
    assert len(read_obj(write(tmp_path, GOOD.replace("\n", "\r\n"))).faces) == 2


def test_quads_become_two_triangles_that_share_the_diagonal(tmp_path):
    mesh = read_obj(write(tmp_path, GOOD))
    faces, uv_faces = triangulate(mesh.faces, mesh.uv_faces)
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(uv_faces, [[0, 1, 2], [0, 1, 2], [0, 2, 0]])


DAMAGE = {
    "v 1 1 0\n": ("v 1 nan 0\n", "v: expected finite values"),
    "v 0 0 0\n": ("v 0 0\n", "v: expected 3 numbers a line"),
    "v 0 1 1e-3\n": ("v 0 one 0\n", "v: expected 3 numbers a line"),
    "4/1\n": ("9/1\n", "f: expected indices 0 to 4, found 9"),
    "3/3 4/1\n": ("3/8 4/1\n", r"f \(texture\): expected indices 0 to 3, found 8"),
    "f 1/1/1 2/2/1 3/3/1": ("f 1 2 3", "f: expected corners v/vt, found f 1 2 3"),
    "f 1/1 2/2": ("f -1/1 2/2", "f: expected 3 or 4 corners"),
    "3/3 4/1": ("3/3 4/1 2/2", "f: expected 3 or 4 corners"),
}


@pytest.mark.parametrize("old", DAMAGE)
def test_damage(tmp_path, old):
    new, message = DAMAGE[old]
    assert old in GOOD
    with pytest.raises(DataError, match=message) as caught:
        read_obj(write(tmp_path, GOOD.replace(old, new, 1)))
    assert "\n" not in str(caught.value)


def test_no_vertices(tmp_path):
    with pytest.raises(DataError, match="v: expected 3 numbers a line, found no such line"):
        read_obj(write(tmp_path, "hello"))
