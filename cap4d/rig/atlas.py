"""Packing texture tiles into one atlas for the UV grid: every tile in a box of its own, the busy parts of a
face larger.
"""

from __future__ import annotations

import numpy as np

Box = tuple[float, float, float, float]  # u0, v0, u1, v1 in [0, 1]

GUTTER = 0.6 / 128  # of the atlas; with it two tiles on a 128 grid are never neighbours within a pixel


def weld(uvs: np.ndarray, uv_faces: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joins texture vertices that have the same place and the same mesh vertex, so that islands are really
    islands.

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


def islands(uv_faces: np.ndarray, n_uvs: int) -> np.ndarray:
    """int[T] a label per connected piece of a texture: the smallest texture vertex in it."""
    label = np.arange(n_uvs)
    while True:
        smallest = label.copy()
        lowest = label[uv_faces].min(1)
        for corner in range(3):
            np.minimum.at(smallest, uv_faces[:, corner], lowest)
        smallest = smallest[smallest]  # pointer jumping: halves the number of rounds
        if (smallest == label).all():
            return label
        label = smallest


def unmirror(uvs: np.ndarray, uv_faces: np.ndarray) -> np.ndarray:
    """[T, 2] with every island that shows its back (clockwise triangles) mirrored in its own bounding
    rectangle.
    """
    label = islands(uv_faces, len(uvs))
    a, b, c = (uvs[uv_faces[:, corner]] for corner in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    area = np.bincount(label[uv_faces[:, 0]], turn, len(uvs))
    low, high = np.full(len(uvs), np.inf), np.full(len(uvs), -np.inf)
    np.minimum.at(low, label, uvs[:, 0])
    np.maximum.at(high, label, uvs[:, 0])
    mirrored = np.column_stack([low[label] + high[label] - uvs[:, 0], uvs[:, 1]])
    return np.where((area < 0)[label, None], mirrored, uvs)


def place(uvs: np.ndarray, box: Box, *, gutter: float = GUTTER) -> np.ndarray:
    """[T, 2] scaled from their bounding rectangle to the box less half a gutter on each side."""
    low, high = uvs.min(0), uvs.max(0)
    start, end = np.array(box[:2]) + gutter / 2, np.array(box[2:]) - gutter / 2
    return start + (uvs - low) / (high - low) * (end - start)


def enlarge_busy(uvs: np.ndarray, weights: np.ndarray, *, strength: float, bins: int = 64) -> np.ndarray:
    """[T, 2] in [0, 1] warped along u and v so that columns and rows with much weight [T] get more room.

    Each axis is mapped by the integral of (1 - strength) + strength * density of the weights, smoothed;
    monotone, so nothing folds beyond what single triangles may.
    """
    warped = np.empty_like(uvs)
    edges = np.linspace(0, 1, bins + 1)
    for axis in range(2):
        density = np.histogram(uvs[:, axis], edges, weights=weights)[0] * (bins / weights.sum())
        density = np.convolve(np.pad(density, 2, mode="edge"), np.hanning(7)[1:-1] / 3, mode="valid")
        room = (1 - strength) + strength * density
        integral = np.concatenate([[0], np.cumsum(room)])
        warped[:, axis] = np.interp(uvs[:, axis], edges, integral / integral[-1])
    return warped


def add_skirts(
    uvs: np.ndarray, uv_faces: np.ndarray, faces: np.ndarray, *, where: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Widens islands by a rim of triangles that have an area in the texture but none in space.

    Where a surface is cut, the last pixel centres of its two islands lie up to a pixel inside the cut, and
    the grid would have a gap there. A rim pixel is a point of the cut itself. The rim comes last, so a
    surface always wins over it; less than 0.7 px wide, it never holds all corners of a grid triangle.

    Args:
        uvs, uv_faces, faces: [T, 2], int[F, 3], int[F, 3].
        where: bool[F] the faces whose common cuts get rims; their borders with other faces get none.
        width: Of the rim, in texture units.
    Returns:
        The same with the rims appended.
    """
    sides, ends = _sides(uv_faces[where]), _sides(faces[where])
    cut = (_uses(sides) == 1) & (_uses(ends) == 2)
    sides, ends = sides[cut], ends[cut]
    along = uvs[sides[:, 1]] - uvs[sides[:, 0]]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    outward = np.column_stack([along[:, 1], -along[:, 0]])  # islands lie to the left of their sides
    push = np.zeros_like(uvs)
    for end in range(2):
        np.add.at(push, sides[:, end], outward)
    rim = np.unique(sides)
    out = push[rim] / np.maximum(np.linalg.norm(push[rim], axis=1, keepdims=True), 1e-12)
    outer = np.zeros(len(uvs), np.int32)
    outer[rim] = len(uvs) + np.arange(len(rim))
    a, b = sides.T
    va, vb = ends.T
    rim_uv_faces = np.concatenate([np.stack([b, a, outer[a]], 1), np.stack([b, outer[a], outer[b]], 1)])
    rim_faces = np.concatenate([np.stack([vb, va, va], 1), np.stack([vb, va, vb], 1)])
    return (
        np.concatenate([uvs, np.clip(uvs[rim] + out * width, 0, 1)]),
        np.concatenate([uv_faces, rim_uv_faces]).astype(np.int32),
        np.concatenate([faces, rim_faces]).astype(np.int32),
    )


def _sides(faces: np.ndarray) -> np.ndarray:
    """int[3 F, 2] the directed sides of triangles."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _uses(sides: np.ndarray) -> np.ndarray:
    """int[N] how often each side occurs, in either direction."""
    _, inverse, count = np.unique(np.sort(sides, 1), axis=0, return_inverse=True, return_counts=True)
    return count[inverse.reshape(-1)]
