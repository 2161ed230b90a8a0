"""The shoulders swept from a neck's open edge."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from cap4d.rig.bust import BOTTOM_BELOW_ORIGIN, N_RINGS, grow_bust, open_edge

L = 24


@pytest.fixture
def edge():
    angle = np.pi + 2 * np.pi * np.arange(L) / L
    return np.stack([0.1 * np.sin(angle), np.full(L, -0.18), 0.07 * np.cos(angle) - 0.06], 1)


@pytest.fixture
def bust(edge):
    return grow_bust(edge, np.stack([edge[:, 0], np.full(L, -0.03), edge[:, 2] + 0.06], 1))


def test_shape(edge, bust):
    rings = bust.vertices.reshape(N_RINGS, L, 3)
    assert np.linalg.norm(rings[0] - edge, axis=1).max() < 0.03  # it starts at the edge
    np.testing.assert_allclose(rings[-1, :, 1], -BOTTOM_BELOW_ORIGIN)
    assert 0.15 < rings[..., 0].max() < 0.25


def test_faces_look_outwards_and_close_the_strip(edge, bust):
    points = np.concatenate([edge, bust.vertices])
    corner = points[bust.faces]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    outwards = corner.mean(1) - [0, -0.25, -0.07]
    lower = corner[:, :, 1].max(1) < -0.22
    assert (np.einsum("ij,ij->i", normals, outwards * [1, 0, 1])[lower] > 0).all()
    assert len(bust.faces) == 2 * N_RINGS * L and len(np.unique(bust.faces)) == (N_RINGS + 1) * L


def test_texture_is_not_mirrored(bust):
    a, b, c = (bust.uvs[bust.uv_faces[:, corner]] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    assert (area > 0).all()
    np.testing.assert_allclose(area.sum() / 2, 1)


def test_offsets_of_the_edge_continue_and_fade_to_their_mean(bust):
    edge_offsets = np.random.default_rng(0).normal(size=(3, L, 3))
    rings = bust.continue_offsets(edge_offsets).reshape(3, N_RINGS, L, 3)
    mean = edge_offsets.mean(1)
    np.testing.assert_allclose(rings[:, -1], np.repeat(mean[:, None], L, 1), atol=1e-12)
    near = np.linalg.norm(rings[:, 0] - edge_offsets, axis=-1).mean()
    assert near < 0.05 * np.linalg.norm(edge_offsets - mean[:, None], axis=-1).mean()
    same = bust.continue_offsets(np.ones((1, L, 3)))
    np.testing.assert_allclose(same, 1)


def test_open_edge_is_the_longest_one_in_order():
    lower = [[i, (i + 1) % 6, 6 + i] for i in range(6)]
    upper = [[(i + 1) % 6, 6 + (i + 1) % 6, 6 + i] for i in range(6)]
    edge = open_edge(np.array([*lower, *upper, [20, 21, 22]])).tolist()
    assert len(edge) == 6
    step = {(b - a) % 6 for a, b in pairwise(edge)}
    assert step in ({1}, {5})
