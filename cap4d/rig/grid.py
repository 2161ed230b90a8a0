"""The surface that carries an avatar's Gaussians: as a rule the UV grid, a rig's surface resampled on a
square image, so that a convolution can move it (facts 16-19); or the rig's own triangles.

Pixel (row, column) of a grid of S x S is the surface point at v = (row + 0.5) / S, u = 1 - (column + 0.5) /
S: the texture turned by 180 degrees, as the released system has it. The map from rig vertices to grid
vertices is sparse and fixed, so blendshapes are evaluated straight on the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from cap4d import _core
from cap4d.errors import ArgumentError
from cap4d.rig.atlas import islands
from cap4d.rig.head import HeadRig, Subject
from cap4d.rotation import Array, namespace

Model = TypeVar("Model", HeadRig, Subject)

NO_AREA = 1e-12  # m^2: a triangle a micrometre across


@dataclass(frozen=True, eq=False)
class UvGrid:
    """A fixed remesh of a rig; G is the number of pixels that lie on the surface, M the number of triangles.

    The rig's own triangles are one of size 0: its vertices are the rig's, none lies on a pixel, and no
    network can see or move them.

    Args:
        size: S, pixels a side; 0: the rig's own triangles.
        pixels: int16[G, 2] row and column of each grid vertex, in scan order; [0, 2] of size 0.
        faces: int32[M, 3] into the G grid vertices, in the order of fact 18 (Gaussians are bound by face
            index).
        deformable: bool[G] where the deformation network may move the surface with the expression (fact 19).
        vertices: int32[G, 3] the rig vertices each grid vertex mixes.
        bary: float32[G, 3] their weights.
    """

    size: int
    pixels: np.ndarray
    faces: np.ndarray
    deformable: np.ndarray
    vertices: np.ndarray
    bary: np.ndarray

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def is_mesh(self) -> bool:
        """Whether it is the rig's own triangles, without pixels."""
        return self.size == 0

    @property
    def valid(self) -> np.ndarray:
        """bool[S, S]: the pixels that lie on the surface."""
        valid = np.zeros((self.size, self.size), bool)
        valid[self.pixels[:, 0], self.pixels[:, 1]] = True
        return valid

    def to_map(self, values: Array) -> Array:
        """[..., G, C] values of the grid vertices -> [..., C, S, S] image, zero off the surface."""
        xp = namespace(values)
        lead, channels = values.shape[:-2], values.shape[-1]
        kind = {} if xp is np else {"device": values.device}
        flat = xp.zeros((*lead, self.size * self.size, channels), dtype=values.dtype, **kind)
        flat[..., self._scan_index(values), :] = values
        return flat.reshape(*lead, self.size, self.size, channels).swapaxes(-1, -2).swapaxes(-2, -3)

    def from_map(self, image: Array) -> Array:
        """[..., C, S, S] image -> [..., G, C] its values at the grid vertices."""
        flat = image.reshape(*image.shape[:-2], self.size * self.size)
        return flat[..., self._scan_index(image)].swapaxes(-1, -2)

    def _scan_index(self, like: Array) -> Array:
        index = self.pixels[:, 0].astype(np.int64) * self.size + self.pixels[:, 1]
        xp = namespace(like)
        return index if xp is np else xp.as_tensor(index, device=like.device)


def build_grid(rig: HeadRig, size: int = 128) -> UvGrid:
    """The UV grid of a rig.

    For FLAME with CAP4D's avatar template and S = 128 it has the released system's 14,425 grid vertices,
    28,120 faces and 8,424 deformable vertices. Two rules go beyond facts 16-19 and change nothing there:
    where UV islands overlap the lower face index is seen, and no face spans two UV islands (a packed atlas
    has them a fraction of a pixel apart).

    Args:
        rig: Any rig with UVs.
        size: S, pixels a side.
    Raises:
        ArgumentError: The rig has no UVs, or `size` is not 2 to 4096.
    """
    if not 2 <= size <= 4096:
        raise ArgumentError(f"size: expected 2 to 4096 px, got {size}")
    if not len(rig.uv_faces):
        raise ArgumentError(
            f"{rig.name}: a UV grid needs a rig with UVs (FLAME has them when imported with --assets)"
        )
    seen, bary = _rasterize_uvs(rig, size)
    valid = seen >= 0
    pixels = np.argwhere(valid)
    face = seen[valid]
    island = np.full(seen.shape, -1)
    island[valid] = islands(rig.uv_faces, len(rig.uvs))[rig.uv_faces[face, 0]]
    deformable = np.zeros(len(rig.template), bool)
    deformable[rig.regions["deformable"]] = True
    return UvGrid(
        size=size,
        pixels=pixels.astype(np.int16),
        faces=_grid_faces(island),
        deformable=deformable[rig.faces[face]].all(1),
        vertices=rig.faces[face].astype(np.int32),
        bary=bary[valid].astype(np.float32),
    )


def own_triangles(rig: HeadRig) -> UvGrid:
    """The rig's own mesh, as GaussianAvatars uses it (Qian et al. 2024): needs no UVs and takes no network.

    Left out are triangles that have no area, which have no frame for a Gaussian (seams that only hold an
    atlas together, both ends of a half-sphere), and those that lie on another of the same corners, whichever
    way they face: the two sides of one triangle would be fitted twice.

    Raises:
        ArgumentError: The rig has no triangle with an area.
    """
    faces = np.asarray(rig.faces, np.int32)
    corners = rig.template.astype(np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.flatnonzero(np.linalg.norm(normals, axis=1) > 2 * NO_AREA)
    first = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True)[1]
    if not len(first):
        raise ArgumentError(f"{rig.name}: expected triangles that have an area, got {len(faces)} without")
    return mesh_grid(faces[kept[np.sort(first)]], len(rig.template))


def mesh_grid(faces: np.ndarray, points: int) -> UvGrid:
    """A mesh as a surface of size 0: int[M, 3] triangles into `points` vertices, which mix nothing."""
    return UvGrid(
        size=0,
        pixels=np.zeros((0, 2), np.int16),
        faces=np.ascontiguousarray(faces, np.int32),
        deformable=np.zeros(points, bool),
        vertices=np.repeat(np.arange(points, dtype=np.int32)[:, None], 3, axis=1),
        bary=np.tile(np.float32([1, 0, 0]), (points, 1)),
    )


def remesh(model: Model, grid: UvGrid) -> Model:
    """The rig or subject standing on the grid's G vertices. Linear blendshapes commute with this exactly."""
    return model.resample(grid.vertices, grid.bary)


def _rasterize_uvs(rig: HeadRig, size: int) -> tuple[np.ndarray, np.ndarray]:
    """int32[S, S] the face at each pixel centre or -1, float64[S, S, 3] barycentrics. Mirrored faces are not
    seen.
    """
    u, v = rig.uvs.astype(np.float64).T
    xyz = np.stack([(1 - u) * size, v * size, np.zeros_like(u)], -1)
    return _core.rasterize_mesh(xyz, np.ascontiguousarray(rig.uv_faces, np.int32), size, size, "clockwise")


def _grid_faces(island: np.ndarray) -> np.ndarray:
    """int32[M, 3]: two triangles per 2x2 cell, where all corners are on one island; columns outer, rows inner
    (fact 18).
    """
    valid = island >= 0
    index = np.cumsum(valid).reshape(valid.shape) - 1
    rows, columns = np.arange(island.shape[0] - 1), np.arange(island.shape[1] - 1)
    column, row = (x.ravel() for x in np.meshgrid(columns, rows, indexing="ij"))
    upper = [(row, column), (row + 1, column), (row + 1, column + 1)]
    lower = [(row, column), (row + 1, column + 1), (row, column + 1)]
    triangles = np.stack([np.stack([index[at] for at in t], -1) for t in (upper, lower)], 1)
    corners = np.stack([np.stack([island[at] for at in t], -1) for t in (upper, lower)], 1)
    kept = (corners >= 0).all(-1) & (corners == corners[..., :1]).all(-1)
    return triangles[kept].astype(np.int32)
