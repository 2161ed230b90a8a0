"""The ICT head's teeth as two strips of texture: their outsides, as seen around the arch of the jaw.

The model's own texture unrolls every tooth with its root; on a grid of 128 a visible tooth would get a pixel
or two.
"""

from __future__ import annotations

import numpy as np

from cap4d import _core

ARCH_Z = -0.028  # m; z of the vertical axis around which the teeth are seen
TILT = 0.5  # of the view towards the edges of the teeth: downwards onto the lower row, upwards onto the upper
MAX_RISE = 0.0085  # m above or below the middle of the row; beyond it are tips of roots
SEEN_FROM = 1536, 512  # px around and up, of the picture that decides what is visible


def front_strip(
    points: np.ndarray, teeth: np.ndarray, gums: np.ndarray, *, upper: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The visible triangles of a row of teeth, with texture coordinates around and along it.

    Args:
        points: [V, 3] m, rig axes.
        teeth, gums: int[F, 3] the row, and what may hide it.
        upper: Which row.
    Returns:
        int32[N, 3] faces, [T, 2] texture vertices in [0, 1], int32[N, 3] texture faces. The last few faces
        have no area; they join neighbouring teeth to one texture island, so that grid triangles may bridge
        them.
    """
    radius = np.hypot(points[:, 0], points[:, 2] - ARCH_Z)
    around = np.arctan2(points[:, 0], points[:, 2] - ARCH_Z)
    up = points[:, 1] + (TILT if upper else -TILT) * radius
    strip = np.stack([around, up], -1)
    ids = np.unique(teeth)
    strip = (strip - strip[ids].min(0)) / np.ptp(strip[ids], axis=0)
    faces = teeth[_visible(strip, radius, np.concatenate([teeth, gums]), len(teeth))]
    strip = np.stack([around, _straightened(around, up, np.unique(faces))], -1)
    faces = faces[(np.abs(strip[faces, 1]) < MAX_RISE).all(1)]
    ids = np.unique(faces)
    strip = (strip - strip[ids].min(0)) / np.ptp(strip[ids], axis=0)
    faces = np.concatenate([faces, _links(faces, strip)])
    uv_faces = np.searchsorted(ids, faces)
    return faces.astype(np.int32), strip[ids], uv_faces.astype(np.int32)


def _straightened(around: np.ndarray, up: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """[V] m height above the smooth curve that the middle of the row (vertices `ids`) follows."""
    for _ in range(2):
        height = up - np.polyval(np.polyfit(around[ids], up[ids], 4), around)
        ids = ids[np.abs(height[ids]) < MAX_RISE]
    return height


def _visible(strip: np.ndarray, radius: np.ndarray, faces: np.ndarray, n_teeth: int) -> np.ndarray:
    """int[N] the faces among the first `n_teeth` that are outermost somewhere and show their front."""
    width, height = SEEN_FROM
    xyz = np.stack([strip[:, 0] * width, (1 - strip[:, 1]) * height, -radius], -1)
    seen, _ = _core.rasterize_mesh(xyz, np.ascontiguousarray(faces, np.int32), height, width, "clockwise")
    outermost = np.unique(seen)
    return outermost[(outermost >= 0) & (outermost < n_teeth)]


def _links(faces: np.ndarray, strip: np.ndarray) -> np.ndarray:
    """int[N, 3] one triangle without area (a, b, b) from each separate piece to the next along the strip."""
    label = np.arange(len(strip))
    while True:
        lowest = label.copy()
        for corner in range(3):
            np.minimum.at(lowest, faces[:, corner], label[faces].min(1))
        if (lowest == label).all():
            break
        label = lowest[lowest]
    pieces, first = np.unique(label[faces[:, 0]], return_index=True)
    starts = faces[first, 0]
    order = np.argsort([strip[np.unique(faces[label[faces[:, 0]] == piece]), 0].mean() for piece in pieces])
    a, b = starts[order][:-1], starts[order][1:]
    return np.stack([a, b, b], 1)
