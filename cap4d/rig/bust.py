"""Shoulders and chest under a head that ends at the neck: a smooth surface swept from the neck's open edge.

Nothing anatomical, a place for clothes to hang on: it follows the edge it grows from and moves with the neck
joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

N_RINGS = 16
BOTTOM_BELOW_ORIGIN = 0.345  # m; about 25 cm under the chin
BOTTOM_AXES = (0.195, 0.105)  # m; half the width and half the depth of the chest there
BOTTOM_DEPTH = -0.075  # m; z of its centre
LEAVE, ARRIVE = 0.18, 0.20  # m; lengths of the sweep's tangents at the edge and at the bottom


@dataclass(frozen=True, eq=False)
class Bust:
    """R rings of L vertices below an edge of L vertices, ring by ring.

    Args:
        vertices: float64[R L, 3] m.
        faces: int32[F, 3] into edge (0..L-1) followed by the rings (L..).
        uvs: float64[T, 2] in [0, 1]; rings along u, cut open at the loop's first vertex.
        uv_faces: int32[F, 3].
        follow: float64[R L] how much of its edge vertex's own motion each vertex takes over (the rest is the
            mean's).
    """

    vertices: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    uv_faces: np.ndarray
    follow: np.ndarray

    def continue_offsets(self, edge_offsets: np.ndarray) -> np.ndarray:
        """[K, L, 3] offsets of the edge -> [K, R L, 3] of the bust: fading from each vertex's own to their
        mean.
        """
        mean = edge_offsets.mean(1, keepdims=True)
        own = np.tile(edge_offsets - mean, (1, len(self.vertices) // edge_offsets.shape[1], 1))
        return mean + own * self.follow[:, None]


def grow_bust(edge: np.ndarray, leaving: np.ndarray) -> Bust:
    """Sweeps cubic Hermite curves from the neck's edge to an ellipse around the chest.

    Args:
        edge: [L, 3] the open edge, m, rig axes, in order, counter-clockwise seen from above, from the back.
        leaving: [L, 3] direction in which the surface arrives at each edge vertex.
    """
    angle = np.arctan2(edge[:, 0] - edge[:, 0].mean(), edge[:, 2] - BOTTOM_DEPTH)
    x, z = np.sin(angle) * BOTTOM_AXES[0], np.cos(angle) * BOTTOM_AXES[1] + BOTTOM_DEPTH
    bottom = np.stack([x, np.full_like(x, -BOTTOM_BELOW_ORIGIN), z], 1)
    t = (np.arange(1, N_RINGS + 1) / N_RINGS)[:, None, None]
    start = leaving / np.linalg.norm(leaving, axis=1, keepdims=True) * LEAVE
    end = np.array([0, -ARRIVE, 0])
    rings = (
        (2 * t**3 - 3 * t**2 + 1) * edge
        + (t**3 - 2 * t**2 + t) * start
        + (-2 * t**3 + 3 * t**2) * bottom
        + (t**3 - t**2) * end
    )
    follow = np.repeat(((1 - t) ** 2 * (1 + 2 * t)).ravel(), len(edge))
    return Bust(rings.reshape(-1, 3), *_strip(len(edge)), follow)


def _strip(length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces of the closed strip, texture vertices of the opened one, and its texture faces."""
    ring, step = (x.ravel() for x in np.meshgrid(np.arange(N_RINGS), np.arange(length), indexing="ij"))

    def quads(width: int, after: np.ndarray) -> np.ndarray:
        a, b = ring * width + step, ring * width + after
        c, d = b + width, a + width
        return np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)], 1).reshape(-1, 3).astype(np.int32)

    v, u = np.meshgrid(np.arange(length + 1) / length, np.arange(N_RINGS + 1) / N_RINGS)
    return (
        quads(length, (step + 1) % length),
        np.stack([u.ravel(), v.ravel()], -1),
        quads(length + 1, step + 1),
    )


def open_edge(faces: np.ndarray) -> np.ndarray:
    """int[L] the vertices of a mesh's longest open edge, in the order in which its faces run along it."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    present = set(map(tuple, sides))
    after = {a: b for a, b in sides if (b, a) not in present}
    loops = []
    while after:
        loop = [next(iter(after))]
        while loop[-1] in after:
            loop.append(after.pop(loop[-1]))
        loops.append(loop[:-1])
    return np.array(max(loops, key=len), int)
