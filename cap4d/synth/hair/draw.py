"""Pictures of hair: strands lit per point and drawn as thin lines in front of a mesh's depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d import _core
from cap4d.camera import Camera
from cap4d.errors import ArgumentError
from cap4d.mesh import MIN_DEPTH
from cap4d.synth.hair.hair import Hair, best_rotation
from cap4d.synth.hair.occlusion import DIRECTIONS, weights_towards

SOFTNESS = 0.0025  # m behind a surface at which hair has vanished
SAMPLES = 2  # a pixel's side, when no depth says otherwise
OPACITY = 0.85
GLOSS, GLOSS_POWER, GLOSS_SHIFT = 0.9, 50.0, 0.06  # of the reflection at a strand's surface
GLOW, GLOW_POWER, GLOW_SHIFT = 0.55, 14.0, -0.10  # of light that leaves it after a reflection inside

SKIN_GLOSS = 0.2  # eyebrows and lashes shine this much as hair does
TILT, GOLDEN = np.float32(0.16), np.float32(0.618034)  # scales of single hairs tilt differently


@dataclass(frozen=True, eq=False)
class HairLights:
    """Lights in the frame of the posed points.

    Args:
        directions: [L, 3] towards each light; strengths: [L].
        sky, ground: Light without direction, from `up` [3] and from below.
    """

    directions: np.ndarray
    strengths: np.ndarray
    sky: float
    ground: float
    up: np.ndarray


@dataclass(frozen=True, eq=False)
class HairLayer:
    """rgb float32[H, W, 3] premultiplied sRGB and alpha float32[H, W] of the hair that is seen."""

    rgb: np.ndarray
    alpha: np.ndarray


@dataclass(frozen=True, eq=False)
class LitHair:
    """Hair in one pose under lights, and all of its shading that does not depend on where it is seen from.

    Args:
        points: float32[K, P, 3] from `hair.pose`, m; tangent: [K, P, 3] unit.
        directions: float32[L, 3] unit, towards the lights.
        reached: float32[L, K, P] light that a point can throw back; diffuse: float32[K, P].
    """

    hair: Hair
    points: np.ndarray
    tangent: np.ndarray
    directions: np.ndarray
    reached: np.ndarray
    diffuse: np.ndarray

    def seen_from(self, eye: np.ndarray) -> np.ndarray:
        """float32[K, P, 3] sRGB of every point seen from `eye` [3].

        Kajiya and Kay 1989, with the two highlights that Marschner et al. 2003 found.
        """
        hair, to_eye = self.hair, _unit(eye.astype(np.float32) - self.points)
        tilt = TILT * (np.arange(len(self.points), dtype=np.float32)[:, None] * GOLDEN % 1 - 0.5)
        gloss, glow = np.zeros_like(self.diffuse), np.zeros_like(self.diffuse)
        for towards, reached in zip(self.directions, self.reached, strict=True):
            lean = np.einsum("kpc,kpc->kp", self.tangent, _unit(to_eye + towards)) + tilt
            gloss += reached * _lobe(lean + GLOSS_SHIFT, GLOSS_POWER)
            glow += reached * _lobe(lean + GLOW_SHIFT, GLOW_POWER)
        gloss[hair.skin] *= SKIN_GLOSS
        sheen = (GLOSS * gloss)[..., None] * (0.5 + 0.5 * np.sqrt(hair.colors))
        lit = hair.colors * (self.diffuse + 2 * GLOW * glow)[..., None] + sheen
        return np.clip(np.nan_to_num(lit), 0, 1).astype(np.float32)


def light_hair(hair: Hair, points: np.ndarray, lights: HairLights) -> LitHair:
    """Lights posed hair.

    Args:
        points: float32[K, P, 3] from `hair.pose`; `lights` in the same world.
    Raises:
        ArgumentError: Other strands than the hair's.
    """
    if points.shape != hair.strands.shape:
        raise ArgumentError(f"points: expected {list(hair.strands.shape)}, got {list(points.shape)}")
    turn = _turn_of(hair, points)
    tangent = _unit(np.gradient(points, axis=1))
    out = _unit((hair.through @ DIRECTIONS.astype(np.float32) + 1e-4) @ turn.T.astype(np.float32))
    open_ = hair.through.mean(-1)
    sky = lights.ground + (lights.sky - lights.ground) * (0.5 + 0.5 * out @ np.float32(lights.up))
    diffuse = sky * np.minimum(0.18 + 1.7 * open_, 1.15)
    lengths = np.linalg.norm(lights.directions, axis=1, keepdims=True)
    directions = (lights.directions / lengths).astype(np.float32)
    reached = np.empty((len(directions), *open_.shape), np.float32)
    for i, (towards, strength) in enumerate(zip(directions, lights.strengths, strict=True)):
        arriving = strength * (hair.through @ weights_towards(turn.T @ towards))
        across = np.sqrt(np.maximum(1 - (tangent @ towards) ** 2, 0))
        facing = np.clip((out @ towards + 0.4) / 1.4, 0, 1)
        diffuse += arriving * (0.35 * across + 1.15 * facing)
        reached[i] = arriving * facing
    return LitHair(hair, points, tangent, directions, reached, diffuse)


def draw_hair(lit: LitHair, camera: Camera, depth: np.ndarray | None = None) -> HairLayer:
    """Draws hair in front of a mesh.

    Args:
        camera: Where from, in the points' world.
        depth: [H n, W n] of the mesh along the camera's axis, m, n any whole number; where nothing is, inf or
            0. None hides nothing.
    Raises:
        ArgumentError: The depth's shape does not fit.
    """
    depth, n = _checked_depth(depth, camera)
    hair, points = lit.hair, lit.points
    if not len(points):
        rgb = np.zeros((camera.height, camera.width, 3), np.float32)
        return HairLayer(rgb, np.zeros(rgb.shape[:2], np.float32))
    large = camera.resized(camera.width * n, camera.height * n)
    xyz = _project(points, large)
    rgba = np.empty((*points.shape[:2], 4), np.float32)
    rgba[..., :3] = lit.seen_from(camera.position)
    rgba[..., 3] = OPACITY
    focal = np.float32(0.5 * (large.K[0, 0] + large.K[1, 1]))
    widths = hair.widths * focal / np.maximum(xyz[..., 2], MIN_DEPTH)
    rgb, clear = _core.draw_strands(xyz, rgba, widths.astype(np.float32), depth, SOFTNESS)
    return HairLayer(_smaller(rgb, n), 1 - _smaller(clear, n))


def composite_hair(rgb: np.ndarray, matte: np.ndarray, layer: HairLayer) -> tuple[np.ndarray, np.ndarray]:
    """The layer over a picture: straight rgb [H, W, 3] and matte [H, W] in and out (white where empty)."""
    left = 1 - layer.alpha
    alpha = layer.alpha + matte * left
    premultiplied = layer.rgb + rgb * (matte * left)[..., None]
    straight = premultiplied / np.maximum(alpha, 1e-6)[..., None]
    return np.clip(np.where(alpha[..., None] > 1e-6, straight, 1), 0, 1), alpha


def _smaller(image: np.ndarray, n: int) -> np.ndarray:
    """The means of n x n pixels."""
    total = sum(image[row::n, column::n] for row in range(n) for column in range(n))
    return total / np.float32(n * n)


def _lobe(lean: np.ndarray, power: float) -> np.ndarray:
    return np.maximum(1 - lean**2, 0) ** (power / 2)


def _checked_depth(depth: np.ndarray | None, camera: Camera) -> tuple[np.ndarray, int]:
    """Float32, empty pixels at infinity, and the samples along a pixel's side."""
    size = (camera.height, camera.width)
    if depth is None:
        return np.full((size[0] * SAMPLES, size[1] * SAMPLES), np.inf, np.float32), SAMPLES
    n = depth.shape[0] // size[0] if depth.ndim == 2 else 0
    if n < 1 or depth.shape != (size[0] * n, size[1] * n):
        raise ArgumentError(f"depth: expected a whole multiple of {list(size)}, got {list(depth.shape)}")
    depth = np.ascontiguousarray(depth, np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.inf)), n


def _project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """float32[K, P, 3] px, px, m; not finite where a point is not before the camera."""
    xyz = points.astype(np.float32) @ np.float32(camera.K @ camera.viewmat[:3, :3]).T
    xyz += np.float32(camera.K @ camera.viewmat[:3, 3])
    xyz[..., :2] /= xyz[..., 2:]
    xyz[xyz[..., 2] < MIN_DEPTH] = np.nan
    return xyz


def _turn_of(hair: Hair, points: np.ndarray) -> np.ndarray:
    """[3, 3] the rotation of posed strands against the neutral ones."""
    still = ~hair.skin if (~hair.skin).any() else hair.skin
    return best_rotation(hair.strands[still, 0].astype(np.float64), points[still, 0].astype(np.float64))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.sqrt(np.einsum("...c,...c->...", v, v)), 1e-9)[..., None]
