"""Triangles that hardly are any, for the tests of binding: slivers, closed lids, inverted, flat ones."""

from __future__ import annotations

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def triangles(corners: np.ndarray) -> Mesh:
    """A mesh of [M, 3, 3] triangles, each of its own vertices."""
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return np.ascontiguousarray(corners.reshape(-1, 3), np.float32), faces


def slivers(height: float, *, seed: int = 0, count: int = 40, shift: float = 0.0) -> Mesh:
    """Triangles of an edge of about 1 cm and any height over it, the third corner anywhere along it."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    edge = 0.01 * np.exp(rng.normal(0, 0.3, (count, 1))) * axes[:, 0]
    side = rng.uniform(-0.5, 1.5, (count, 1)) * edge + height * axes[:, 1]
    origin = rng.normal(0, 0.1, (count, 3)) + shift
    return triangles(np.stack([origin, origin + edge, origin + side], 1))


def closing_eyelid() -> Mesh:
    """Triangles of a lid that folds away: heights from 3 mm to 0.2 um (from 0.1 um there is no gradient)."""
    heights = np.repeat(3e-3 * 0.5 ** np.arange(15), 4)
    rng = np.random.default_rng(1)
    start = rng.normal([0.03, 0.02, 0.05], 0.01, (len(heights), 3))
    edge, down = np.array([2e-3, 0, 3e-4]), np.array([0, -1, 0.2])
    return triangles(np.stack([start, start + edge, start + 0.5 * edge + heights[:, None] * down], 1))


def inverted() -> Mesh:
    """The slivers and good triangles, wound the other way."""
    vertices, faces = slivers(5e-3, seed=2)
    return vertices, np.ascontiguousarray(faces[:, ::-1])


MESHES = {
    "good": lambda: slivers(8e-3),
    "sliver_1e-4": lambda: slivers(1e-4),
    "sliver_1e-6": lambda: slivers(1e-6),
    "eyelid": closing_eyelid,
    "inverted": inverted,
    "micrometre": lambda: (slivers(8e-3)[0] * np.float32(1e-4), slivers(8e-3)[1]),
    "kilometre": lambda: (slivers(8e-3)[0] * np.float32(1e5), slivers(8e-3)[1]),
    "far_away": lambda: slivers(8e-3, shift=1e4),
}


FLAT = {
    "point": [[1, 1, 1], [1, 1, 1], [1, 1, 1]],
    "no_first_edge": [[1, 1, 1], [1, 1, 1], [2, 1, 1]],
    "no_second_edge": [[1, 1, 1], [2, 1, 1], [1, 1, 1]],
    "line": [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
    "skew_line": [[0.1, 0.2, 0.3], [0.4, 0.6, 0.9], [0.7, 1.0, 1.5]],
    "tiny": [[0, 0, 0], [1e-15, 0, 0], [0, 1e-15, 0]],
    "denormal": [[0, 0, 0], [1e-42, 0, 0], [0, 1e-43, 0]],
    "long": [[0, 0, 0], [1e30, 0, 0], [0, 1e30, 1e30]],
}


def flat_among_others(name: str) -> Mesh:
    """The triangle FLAT[name], and three sound ones."""
    neighbours = slivers(5e-3, count=3)[0].reshape(3, 3, 3)
    return triangles(np.stack([np.float32(FLAT[name]), *neighbours]))
