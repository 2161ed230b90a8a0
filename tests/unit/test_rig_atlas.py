"""Packing texture tiles: islands, mirroring, boxes, warping, rims."""

from __future__ import annotations

import numpy as np

from cap4d.rig.atlas import add_skirts, enlarge_busy, islands, place, unmirror, weld

SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def signed_area(uvs, uv_faces):
    a, b, c = (uvs[uv_faces[:, corner]] for corner in range(3))
    return ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / 2


def test_weld_joins_what_is_one_point():
    uvs = SQUARE[[0, 1, 2, 0, 2, 3]]
    welded, uv_faces = weld(uvs, np.arange(6).reshape(2, 3), HALVES)
    assert len(welded) == 4
    np.testing.assert_array_equal(welded[uv_faces], uvs.reshape(2, 3, 2))
    other_point = np.array([[0, 1, 2], [9, 2, 3]])  # same place, another mesh vertex
    assert len(weld(uvs, np.arange(6).reshape(2, 3), other_point)[0]) == 5


def test_islands():
    chain = np.array([[8, 7, 6], [6, 5, 4], [4, 3, 2], [1, 0, 9]])
    np.testing.assert_array_equal(islands(chain, 10), [0, 0, 2, 2, 2, 2, 2, 2, 2, 0])


def test_unmirror_turns_single_islands_in_place():
    uvs = np.concatenate([SQUARE, SQUARE[[1, 0, 3, 2]] + [3, 0]])
    uv_faces = np.concatenate([HALVES, HALVES + 4])
    turned = unmirror(uvs, uv_faces)
    assert (signed_area(turned, uv_faces) > 0).all()
    np.testing.assert_array_equal(turned[:4], uvs[:4])
    np.testing.assert_array_equal(turned[4:].min(0), [3, 0])
    np.testing.assert_array_equal(turned[4:].max(0), [4, 1])


def test_place_fills_the_box_less_the_gutter():
    placed = place(SQUARE * 5 - 2, (0.25, 0.5, 0.5, 1.0), gutter=0.02)
    np.testing.assert_allclose(placed, [[0.26, 0.51], [0.49, 0.51], [0.49, 0.99], [0.26, 0.99]])


def test_busy_places_get_more_room_and_order_stays():
    rng = np.random.default_rng(0)
    uvs = np.concatenate([rng.uniform(size=(500, 2)), rng.uniform(0.4, 0.5, size=(500, 2))])
    warped = enlarge_busy(uvs, np.ones(1000), strength=0.5)
    for axis in range(2):
        order = np.argsort(uvs[:, axis])
        assert (np.diff(warped[order, axis]) >= 0).all()
    assert np.ptp(warped[500:, 0]) > 1.8 * np.ptp(uvs[500:, 0])
    assert warped.min() >= 0 and warped.max() <= 1
    np.testing.assert_allclose(enlarge_busy(uvs, np.ones(1000), strength=0), uvs, atol=1e-12)


def test_skirts_grow_at_common_cuts_only():
    """Two squares that share a mesh edge but not its texture: rims there, none along the outer borders."""
    uvs = np.concatenate([SQUARE * 0.3 + 0.1, SQUARE * 0.3 + 0.6])
    uv_faces = np.concatenate([HALVES, HALVES + 4])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])  # the edge (1, 2) is cut
    new_uvs, new_uv_faces, new_faces = add_skirts(uvs, uv_faces, faces, where=np.ones(4, bool), width=0.01)
    rim = new_faces[4:]
    assert len(rim) == 4 and np.isin(rim, [1, 2]).all()  # no area in space
    assert all(len(set(triangle)) == 2 for triangle in rim.tolist())
    area = signed_area(new_uvs, new_uv_faces)[4:]
    assert (area > 0).all()
    np.testing.assert_allclose(area.sum(), 2 * 0.3 * 0.01)


def test_skirts_of_nothing():
    found = add_skirts(SQUARE, HALVES, HALVES, where=np.zeros(2, bool), width=0.01)
    assert [len(x) for x in found] == [4, 2, 2]
