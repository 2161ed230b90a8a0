"""Surfaces as grids of vertices, and how half a head of them becomes a whole mesh.

Every part is modelled for x >= 0 as one or more grids over a shared list of points; `mirrored` welds on the
other half. Grids run counter-clockwise seen from outside when, looked at, columns go right and rows go down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

MIDLINE = 1e-6  # mm; points nearer to the mirror plane belong to both halves


@dataclass(frozen=True, eq=False)
class Grid:
    """ids int[R, C] vertices, uv [R, C, 2] in [0, 1]; `holes` are rows r whose quads to row r + 1 are left
    out.
    """

    ids: np.ndarray
    uv: np.ndarray
    holes: tuple[int, ...] = ()

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """[F, 3] vertex ids and [F, 3] indices into the flattened uv; triangles without area in the mesh are
        dropped.
        """
        rows, columns = self.ids.shape
        flat = np.arange(rows * columns).reshape(rows, columns)
        keep = np.ones(rows - 1, bool)
        keep[list(self.holes)] = False
        a, b = flat[:-1, :-1][keep].ravel(), flat[:-1, 1:][keep].ravel()
        c, d = flat[1:, 1:][keep].ravel(), flat[1:, :-1][keep].ravel()
        corners = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])
        faces = self.ids.ravel()[corners]
        solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        return faces[solid], corners[solid]


@dataclass(frozen=True, eq=False)
class Part:
    """Half of a part: points [N, 3] mm with x >= 0 on or off the midline, its grids, and values per point.

    `other`: the right half where it is not the left one's mirror image, also with x >= 0 and of the same
    grids.
    """

    name: str
    points: np.ndarray
    grids: tuple[Grid, ...]
    colors: np.ndarray
    marks: dict[str, np.ndarray] = field(default_factory=dict)
    other: Part | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    """The whole head. points [V, 3] mm; `part` int[V] index into `names`; `partner` int[V] the mirrored
    vertex.
    """

    points: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    uv_faces: np.ndarray
    colors: np.ndarray
    names: tuple[str, ...]
    part: np.ndarray
    partner: np.ndarray
    marks: dict[str, np.ndarray]

    def of(self, *names: str) -> np.ndarray:
        """bool[V] the vertices of the named parts."""
        return np.isin(self.part, [self.names.index(n) for n in names])


PlaceUv = Callable[["Part", np.ndarray], np.ndarray]


def assemble(parts: list[Part], left_uv: PlaceUv, right_uv: PlaceUv) -> Mesh:
    """Joins the half parts and their mirror images; the two functions put a part's uv into the atlas."""
    right_halves = [p.other or p for p in parts]
    points, right = (np.concatenate([p.points for p in half]) for half in (parts, right_halves))
    part = np.repeat(np.arange(len(parts)), [len(p.points) for p in parts])
    n = len(points)
    middle = np.abs(points[:, 0]) < MIDLINE
    points[middle, 0] = 0
    other = np.where(middle, np.arange(n), 0)
    other[~middle] = n + np.arange((~middle).sum())
    partner = np.concatenate([other, np.flatnonzero(~middle)])
    faces, uvs, uv_faces, start, uv_start = [], [], [], 0, 0
    for p in parts:
        for grid in p.grids:
            ids, corners = grid.triangles()
            ids, uv = ids + start, grid.uv.reshape(-1, 2)
            faces += [ids, other[ids][:, ::-1]]
            uvs += [left_uv(p, uv), right_uv(p, uv)]
            uv_faces += [corners + uv_start, corners[:, ::-1] + uv_start + len(uv)]
            uv_start += 2 * len(uv)
        start += len(p.points)
    uvs, welded = np.unique(np.round(np.concatenate(uvs), 7), axis=0, return_inverse=True)
    uv_faces = welded.reshape(-1)[np.concatenate(uv_faces)]  # neighbours share UVs too: the grid goes by them
    marks = {}
    for name in sorted({m for p in parts for m in p.marks}):
        left_half, right_half = (
            np.concatenate([p.marks.get(name, np.zeros(len(p.points))) for p in half])
            for half in (parts, right_halves)
        )
        marks[name] = np.concatenate([left_half, right_half[~middle]])
    colors, right_colors = (np.concatenate([p.colors for p in half]) for half in (parts, right_halves))
    return Mesh(
        points=np.concatenate([points, right[~middle] * [-1, 1, 1]]),
        faces=np.concatenate(faces),
        uvs=uvs,
        uv_faces=uv_faces,
        colors=np.concatenate([colors, right_colors[~middle]]),
        names=tuple(p.name for p in parts),
        part=np.concatenate([part, part[~middle]]),
        partner=partner,
        marks=marks,
    )


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between; works with low > high too."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def curve(x: np.ndarray, knots: list[tuple[float, float]], *, soft: float = 5.0) -> np.ndarray:
    """A smooth function through about `knots` (x, y): broken lines blurred by a Gaussian of `soft`, flat at
    both ends.
    """
    knot_x, knot_y = np.array(knots, float).T
    fine = np.arange(knot_x[0] - 4 * soft, knot_x[-1] + 4 * soft, soft / 8)
    reflected = np.where(fine < knot_x[0], 2 * knot_x[0] - fine, fine)
    reflected = np.where(reflected > knot_x[-1], 2 * knot_x[-1] - reflected, reflected)
    kernel = np.exp(-0.5 * (np.arange(-24, 25) / 8) ** 2)
    padded = np.pad(np.interp(reflected, knot_x, knot_y), 24, mode="edge")
    return np.interp(x, fine, np.convolve(padded, kernel / kernel.sum(), "valid"))
