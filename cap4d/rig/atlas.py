"""Packing texture tiles into one atlas for the UV grid: every tile in a box of its own, the busy parts of a face larger."""

from __future__ import annotations

import numpy as np

Box = tuple[float, float, float, float]  # u0, v0, u1, v1 in [0, 1]

GUTTER = 0.6 / 128  # of the atlas; with it two tiles on a 128 grid are never neighbours within a pixel


def weld(uvs: np.ndarray, uv_faces: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joins texture vertices that have the same place and the same mesh vertex, so that islands are really islands.

    Args:
        uvs, uv_faces, faces: [T, 2], int[F, 3], int[F, 3].
    Returns:
        [T', 2] the texture vertices in use, int32[F, 3].
    """
    corners = uv_faces.ravel()
    place = np.round(uvs[corners] * 1e5).astype(np.int64)
    keys = np.column_stack([faces.ravel(), place])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return uvs[corners[first]], inverse.reshape(uv_faces.shape).astype(np.int32)


def place(uvs: np.ndarray, box: Box) -> np.ndarray:
    """[T, 2] scaled from their bounding rectangle to the box less half a gutter on each side."""
    low, high = uvs.min(0), uvs.max(0)
    start, end = np.array(box[:2]) + GUTTER / 2, np.array(box[2:]) - GUTTER / 2
    return start + (uvs - low) / (high - low) * (end - start)


def enlarge_busy(uvs: np.ndarray, strength: float, bins: int = 64) -> np.ndarray:
    """[T, 2] in [0, 1] warped along u and v so that columns and rows with many vertices get more room.

    Each axis is mapped by the integral of (1 - strength) + strength * vertex density, smoothed; monotone, so nothing
    folds beyond what single triangles may.
    """
    warped = np.empty_like(uvs)
    edges = np.linspace(0, 1, bins + 1)
    for axis in range(2):
        density = np.histogram(uvs[:, axis], edges)[0] * (bins / len(uvs))
        density = np.convolve(np.pad(density, 4, mode="edge"), np.hanning(11)[1:-1] / 5, mode="valid")
        room = (1 - strength) + strength * density
        integral = np.concatenate([[0], np.cumsum(room)])
        warped[:, axis] = np.interp(uvs[:, axis], edges, integral / integral[-1])
    return warped
