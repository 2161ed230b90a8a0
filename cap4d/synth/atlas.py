"""The texels of a rig's texture as points on its template: where procedural paint is evaluated.

Paint depends on the place on the template alone, so it sticks to the skin and two rigs' sizes agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cap4d import _core
from cap4d.errors import ArgumentError
from cap4d.rig import paint
from cap4d.rig.head import HeadRig

KINDS = ("skin", "eye", "teeth", "gums", "cavity", "cloth")


@dataclass(frozen=True, eq=False)
class Atlas:
    """P texels that some triangle covers, of a texture of S x S.

    Args:
        size: S.
        pixels: int[P] row * S + column.
        points: float32[P, 3] on the template, rig axes, m.
        kinds: float32[P, 6] how much each texel is of each of KINDS.
        old: float32[P, 3] the rig's own colours there, sRGB.
        uvs: float32[T, 2] the rig's texture vertices as column and row.
        corners, weights: int[P, 3] and float32[P, 3] the vertices that each texel is a mixture of.
    """

    size: int
    pixels: np.ndarray
    points: np.ndarray
    kinds: np.ndarray
    old: np.ndarray
    uvs: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def of(self, kind: str) -> np.ndarray:
        """int[N] the texels that are mostly of one kind."""
        return np.flatnonzero(self.kinds.argmax(1) == KINDS.index(kind))

    def of_vertices(self, values: np.ndarray, texels: np.ndarray) -> np.ndarray:
        """[V] values of vertices -> [N] of `texels`."""
        return (values[self.corners[texels]] * self.weights[texels]).sum(1)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """[P, C] -> float32[S, S, C]; texels that nothing covers take the nearest one's, for filters."""
        image = values.astype(np.float32)[self._nearest]
        return image.reshape(self.size, self.size, -1)

    @cached_property
    def _nearest(self) -> np.ndarray:
        """int[S S] for every texel of the texture the nearest that is covered."""
        from scipy.ndimage import distance_transform_edt

        index = np.full(self.size * self.size, -1)
        index[self.pixels] = np.arange(len(self.pixels))
        square = index.reshape(self.size, self.size)
        rows, columns = distance_transform_edt(square < 0, return_distances=False, return_indices=True)
        return square[rows, columns].ravel()


def build_atlas(rig: HeadRig, size: int) -> Atlas:
    """Raises ArgumentError when the rig has no UVs."""
    if not len(rig.uv_faces):
        raise ArgumentError(f"{rig.name}: expected a rig with UVs to paint on")
    u, v = rig.uvs.astype(np.float64).T
    uvs = np.stack([u * size, (1 - v) * size], -1)
    flat = np.column_stack([uvs, np.zeros(len(uvs))])
    faces = np.ascontiguousarray(rig.uv_faces, np.int32)
    face, bary = _core.rasterize_mesh(flat, faces, size, size, "none")
    pixels = np.flatnonzero(face.ravel() >= 0)
    corners, weights = rig.faces[face.ravel()[pixels]], bary.reshape(-1, 3)[pixels].astype(np.float32)

    def on_texels(values: np.ndarray) -> np.ndarray:
        return np.einsum("pk,pkc->pc", weights, values.astype(np.float32)[corners])

    colors = np.tile(np.float32(paint.SKIN), (len(rig.template), 1)) if rig.colors is None else rig.colors
    return Atlas(
        size=size,
        pixels=pixels,
        points=on_texels(rig.template),
        kinds=on_texels(np.eye(len(KINDS))[kinds_of_vertices(rig)]),
        old=on_texels(colors),
        uvs=uvs.astype(np.float32),
        corners=corners,
        weights=weights,
    )


def kinds_of_vertices(rig: HeadRig) -> np.ndarray:
    """int[V] index into KINDS, from the rig's regions and its own colours."""
    kinds = np.zeros(len(rig.template), int)
    for region, kind in (("mouth", "gums"), ("teeth", "teeth"), ("eyes", "eye"), ("bust", "cloth")):
        kinds[rig.regions.get(region, [])] = KINDS.index(kind)
    if rig.colors is not None:
        dark = rig.colors.sum(1) < 1.25
        kinds[dark & (kinds == KINDS.index("gums"))] = KINDS.index("cavity")
        red = rig.colors[:, 0] - rig.colors[:, 1] > 0.25  # gums that count as teeth
        kinds[red & (kinds == KINDS.index("teeth"))] = KINDS.index("gums")
    return kinds
