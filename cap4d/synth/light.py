"""Lights that stand still about the head, and how much of them and of the sky each vertex sees.

The shadows are soft and cast once, by the head at rest: an avatar's colours are fixed to its surface, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d import _core
from cap4d.mesh import vertex_normals

SHADOW_MAP = 320  # px a side
EXTENT = 0.44  # m that a shadow map shows
BIAS = 2.2e-3  # m towards the outside, so that a surface does not shade itself
SKY_DIRECTIONS = 96
LIGHT_SAMPLES, LIGHT_RADIUS = 14, 0.16  # of each light: directions, and how far they stray (tangent)


@dataclass(frozen=True, eq=False)
class Lights:
    """L lights in the head's frame, OpenCV axes: `directions` float32[L, 3] to them, `colors` float32[L, 3]
    and `sky`, `ground` float32[3], linear RGB.
    """

    directions: np.ndarray
    colors: np.ndarray
    sky: np.ndarray
    ground: np.ndarray


@dataclass(frozen=True, eq=False)
class Occlusion:
    """How much each of V vertices sees: `open` float32[V] of the sky, `visible` float32[V, L] of lights."""

    open: np.ndarray
    visible: np.ndarray

    def mixed(self, other: Occlusion, weight: np.ndarray) -> Occlusion:
        """This one and, where `weight` [V] is 1, the other."""
        w = weight.astype(np.float32)
        visible = self.visible + w[:, None] * (other.visible - self.visible)
        return Occlusion(self.open + w * (other.open - self.open), visible)

    def dimmed(self, share: np.ndarray) -> Occlusion:
        """Times `share` [V]."""
        share = share.astype(np.float32)
        return Occlusion(self.open * share, self.visible * share[:, None])


def draw_lights(rng: np.random.Generator) -> Lights:
    """A key light from one side above, a fill from the other, and a rim light from behind."""
    side = rng.choice([-1, 1])
    angles = [
        (side * rng.uniform(20, 48), rng.uniform(22, 42)),
        (-side * rng.uniform(40, 70), rng.uniform(0, 20)),
        (-side * rng.uniform(125, 160), rng.uniform(15, 40)),
    ]
    warmth = rng.uniform(-0.10, 0.16)
    tint = np.array([[1 + warmth, 1, 1 - warmth], [1 - warmth, 1, 1 + warmth], [1, 1, 1.0]])
    strength = np.array([rng.uniform(0.78, 1.0), rng.uniform(0.16, 0.32), rng.uniform(0.3, 0.6)])
    yaw, pitch = np.radians(np.array(angles)).T
    directions = np.stack([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), -np.cos(yaw) * np.cos(pitch)], 1)
    sky = rng.uniform(0.32, 0.42) * np.array([0.97, 1.0, 1.05])
    return Lights(
        directions.astype(np.float32),
        (tint * strength[:, None]).astype(np.float32),
        sky.astype(np.float32),
        (0.55 * sky * [1.06, 1.0, 0.94]).astype(np.float32),
    )


def cast_shadows(vertices: np.ndarray, faces: np.ndarray, lights: Lights) -> Occlusion:
    """Soft shadows of a mesh [V, 3] in the lights' frame."""
    normals = vertex_normals(vertices, faces)
    outside = vertices + BIAS * normals
    weighed, total = np.zeros(len(vertices)), np.full(len(vertices), 1e-6)
    for direction in _sphere(SKY_DIRECTIONS):
        facing = np.maximum(normals @ direction, 0)
        weighed += facing * _sees(outside, vertices, faces, direction)
        total += facing
    visible = np.zeros((len(vertices), len(lights.directions)))
    for i, light in enumerate(lights.directions):
        for direction in _cone(light.astype(np.float64)):
            visible[:, i] += _sees(outside, vertices, faces, direction) / LIGHT_SAMPLES
    return Occlusion((weighed / total).astype(np.float32), visible.astype(np.float32))


def _sees(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """float[N] 1 where nothing of the mesh stands between a point and a far light."""
    right = np.cross(direction, [0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(direction, right), -direction], 1)
    scale = SHADOW_MAP / EXTENT

    def project(p: np.ndarray) -> np.ndarray:
        q = p @ axes
        return np.concatenate([q[:, :2] * scale + SHADOW_MAP / 2, q[:, 2:]], 1)

    seen = project(vertices)
    face, bary = _core.rasterize_mesh(seen, faces, SHADOW_MAP, SHADOW_MAP, "none")
    nearest = (bary * seen[:, 2][faces[np.maximum(face, 0)]]).sum(-1)
    nearest[face < 0] = np.inf
    x, y, depth = project(points).T
    column, row = (np.clip(np.floor(v).astype(int), 0, SHADOW_MAP - 1) for v in (x, y))
    return (depth <= nearest[row, column] + 1e-4).astype(np.float64)


def _sphere(count: int) -> np.ndarray:
    """[count, 3] directions spread evenly over the sphere (Fibonacci's spiral)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)


def _cone(axis: np.ndarray) -> np.ndarray:
    """[LIGHT_SAMPLES, 3] directions of a disc of light."""
    side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    i = np.arange(LIGHT_SAMPLES) + 0.5
    radius, angle = LIGHT_RADIUS * np.sqrt(i / LIGHT_SAMPLES), np.pi * (1 + 5**0.5) * i
    spread = np.outer(radius * np.cos(angle), side) + np.outer(radius * np.sin(angle), np.cross(axis, side))
    cone = axis + spread
    return cone / np.linalg.norm(cone, axis=1, keepdims=True)
