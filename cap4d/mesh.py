"""Pictures of triangle meshes: which triangle a pixel sees, and a plain shaded image of it.

For looking (rigs, overlays) and for maps over a mesh (UV remeshing, conditioning). Not a renderer of avatars.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d import _core
from cap4d.camera import Camera

MIN_DEPTH = 1e-3  # m; a triangle with a vertex nearer than this is not drawn


@dataclass(frozen=True, eq=False)
class Fragments:
    """What each pixel sees: `face` int32[H, W], or -1; `bary` float64[H, W, 3], perspective-correct."""

    face: np.ndarray
    bary: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """bool[H, W]"""
        return self.face >= 0

    def interpolate(self, values: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Per-vertex [V, C] -> [H, W, C], zero where nothing is seen."""
        corners = values[faces[np.maximum(self.face, 0)]]
        return (corners * self.bary[..., None]).sum(-2) * self.hit[..., None]


def rasterize_mesh(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, *, cull_back: bool = False
) -> Fragments:
    """The nearest triangle per pixel.

    Args:
        vertices: [V, 3] world, m.
        faces: int[F, 3], counter-clockwise seen from outside.
        camera: Pinhole camera.
        cull_back: Skip triangles seen from inside.
    """
    xyz = camera.project(np.asarray(vertices, np.float64))
    # beyond 1e12 px edge functions would cancel, so such vertices count as not finite
    xyz[~(np.abs(xyz).max(1) < 1e12) | (xyz[:, 2] < MIN_DEPTH)] = np.nan
    faces = np.ascontiguousarray(faces, np.int32)
    cull = "clockwise" if cull_back else "none"
    # 1/z is linear in the image, so it orders triangles exactly (negated: nearer is smaller).
    inverse = xyz.copy()
    inverse[:, 2] = -1 / xyz[:, 2]
    face, bary = _core.rasterize_mesh(inverse, faces, camera.height, camera.width, cull)
    over_depth = bary * -inverse[faces[np.maximum(face, 0)], 2]
    total = over_depth.sum(-1, keepdims=True)
    seen = (face >= 0)[..., None]
    return Fragments(face, np.where(seen, over_depth / np.where(seen, total, 1), 0))


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[V, 3] unit normals, the area-weighted mean of the triangles around (zero where there are none)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, corner], face_normals[:, axis], len(vertices))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def shade(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    *,
    colors: np.ndarray | None = None,
    supersample: int = 2,
    ambient: float = 0.55,
) -> np.ndarray:
    """A softly lit picture of a mesh: one key light above the camera, one fill, no shadows.

    Args:
        vertices: [V, 3] world (OpenCV axes), m.
        faces: int[F, 3].
        colors: [V, 3] sRGB albedo; None is light grey.
        supersample: Samples per pixel side.
        ambient: Share of light without direction.
    Returns:
        float32[H, W, 4] sRGB with straight alpha (white where nothing is seen).
    """
    large = camera.resized(camera.width * supersample, camera.height * supersample)
    fragments = rasterize_mesh(vertices, faces, large)
    if colors is None:
        colors = np.full_like(np.asarray(vertices, np.float64), 0.8)
    view_to_world = camera.viewmat[:3, :3].T
    key, fill = (
        view_to_world @ (d / np.linalg.norm(d))
        for d in (np.array([-0.5, -0.8, -1.0]), np.array([0.8, -0.1, -0.8]))
    )
    normals = vertex_normals(np.asarray(vertices, np.float64), faces)
    light = ambient + (1 - ambient) * (
        0.75 * np.maximum(normals @ key, 0) + 0.35 * np.maximum(normals @ fill, 0)
    )
    lit = fragments.interpolate(np.clip(colors * light[:, None], 0, 1), faces)
    rgba = np.concatenate([lit, fragments.hit[..., None]], -1)
    rgba = rgba.reshape(camera.height, supersample, camera.width, supersample, 4).mean((1, 3))
    alpha = rgba[..., 3:]
    rgb = np.where(alpha > 0, rgba[..., :3] / np.maximum(alpha, 1e-6), 1)
    return np.concatenate([rgb, alpha], -1).astype(np.float32)
