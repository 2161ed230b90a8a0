"""Two kinds of seeded scenes with the statistics of trained ones: heads, and a fog of large faint Gaussians.

The shape of the clouds, the law of their sizes and the mix of their opacities decide how much work a picture
is; the report compares the counts with those of the standard scenes (`STANDARD`).
"""

from __future__ import annotations

import numpy as np

from cap4d.camera import Camera
from cap4d.gaussians import Gaussians
from cap4d.rotation import rotmat_to_quat

SEED = 20240611
SIZE = 512  # px a side
FOV_Y_DEG, DISTANCE = 25.0, 0.95  # m
CENTRE = np.array([0.0, 0.02, 0.0])  # looked at, m
HEAD = np.array([0.075, 0.110, 0.095])  # semi-axes, m
COVER = 0.5  # standard deviation of a disc over the side of its share of the surface
SH_DC = 0.28209479177387814
SH_SIGMAS = np.repeat([0.08, 0.05, 0.03], [3, 5, 7])  # of the coefficients of degrees 1, 2 and 3
FOG_PX = 9.0  # standard deviation of the fog's Gaussians

STANDARD = {
    "head_30k": {"inside": 2_468_005, "blended": 2_284_174},
    "head_100k": {"inside": 3_212_702, "blended": 2_677_683},
    "head_300k": {"inside": 5_036_379, "blended": 3_271_710},
    "bad_100k": {"inside": 208_548_145, "blended": 37_242_172},
}
"""Pixel-Gaussian pairs of the standard scenes, view 0, 512 x 512."""


def head_scene(count: int, *, seed: int = SEED) -> Gaussians:
    """A head: 70 % discs on an ellipsoid, denser in front, 15 % strands around it, the rest shoulders."""
    rng = np.random.default_rng([seed, count])
    skin, hair = int(0.7 * count), int(0.15 * count)
    rest = count - skin - hair
    area = 4 * np.pi * float(np.mean((HEAD * np.roll(HEAD, 1)) ** 1.6)) ** (1 / 1.6)  # Thomsen's formula
    base = COVER * np.sqrt(area / skin)
    parts = (_skin(rng, skin, base), _hair(rng, hair, base), _shoulders(rng, rest, base))
    means, normals, along, scales, colors = (np.concatenate(x) for x in zip(*parts, strict=True))
    return _gaussians(rng, means, _quats(normals, along), scales, _trained_opacities(rng, count), colors)


def fog_scene(count: int, *, seed: int = SEED) -> Gaussians:
    """A ball of large, faint, anisotropic Gaussians: what splatters find hardest."""
    rng = np.random.default_rng([seed, count, 777])
    directions = _directions(rng, count)
    metres_per_pixel = DISTANCE * 2 * np.tan(np.radians(FOV_Y_DEG) / 2) / SIZE
    spread = np.exp(rng.normal(0, 0.35, (count, 1)) + rng.normal(0, 0.5, (count, 3)))
    opacities = np.clip(rng.beta(1.5, 25, count), 0.006, 0.5)
    colors = 0.5 + 0.35 * directions + rng.normal(0, 0.1, (count, 3))
    means = directions * 1.25 * HEAD * np.cbrt(rng.random((count, 1)))
    quats = _quats(_directions(rng, count), rng.normal(size=(count, 3)))
    return _gaussians(rng, means, quats, FOG_PX * metres_per_pixel * spread, opacities, colors)


def front_camera(size: int = SIZE) -> Camera:
    """Straight in front of the face, which looks along -z (OpenCV axes: y is down)."""
    focal = 0.5 * size / np.tan(np.radians(FOV_Y_DEG) / 2)
    viewmat = np.eye(4)
    viewmat[:3, 3] = [0, 0, DISTANCE] - CENTRE
    return Camera(np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), viewmat, size, size)


def _skin(rng: np.random.Generator, count: int, base: float) -> tuple[np.ndarray, ...]:
    directions = _directions(rng, 2 * count)
    keep = rng.random(2 * count) < 0.35 + 0.65 * (directions[:, 2] < 0.1)
    directions = np.concatenate([directions[keep], directions[~keep]])[:count]
    normals = _unit(directions / HEAD)
    means = directions * HEAD + normals * rng.normal(0, 0.0012, (count, 1))
    colors = np.array([0.78, 0.57, 0.46]) + 0.1 * np.sin(
        directions @ np.array([[7, 5, 2], [3, 9, 4], [2, 1, 8]])
    )
    return (
        means,
        normals + rng.normal(0, 0.25, (count, 3)),
        rng.normal(size=(count, 3)),
        _discs(rng, count, base),
        colors,
    )


def _hair(rng: np.random.Generator, count: int, base: float) -> tuple[np.ndarray, ...]:
    directions = _directions(rng, 6 * count)
    above = ((directions[:, 1] < -0.15) | (directions[:, 2] > 0.2)) & (directions[:, 1] < 0.6)
    directions = directions[above][:count]
    means = directions * HEAD * (1.06 + 0.1 * rng.random((count, 1)))
    length, width = np.exp(rng.normal(1.1, 0.4, count)), 1.1 * base * np.exp(rng.normal(0, 0.5, count))
    scales = width[:, None] * np.stack([length, np.full(count, 0.45), np.full(count, 0.35)], 1)
    down = np.array([0.1, 1.0, -0.1]) + rng.normal(0, 0.35, (count, 3))
    colors = np.array([0.16, 0.11, 0.08]) + rng.normal(0, 0.05, (count, 3))
    return means, _unit(directions / HEAD) + rng.normal(0, 0.4, (count, 3)), down, scales, colors


def _shoulders(rng: np.random.Generator, count: int, base: float) -> tuple[np.ndarray, ...]:
    neck = rng.random(count) < 0.3
    directions = _directions(rng, count)
    directions[:, 1] = np.where(neck, 0, -np.abs(directions[:, 1]))
    directions = _unit(directions + 1e-9)
    axes = np.where(neck[:, None], [0.05, 0.05, 0.05], [0.19, 0.05, 0.08])
    drop = np.where(neck, 0.085 + 0.07 * rng.random(count), 0.20)
    means = directions * axes + np.stack([0 * drop, drop, np.full(count, 0.02)], 1)
    colors = np.where(neck[:, None], [0.72, 0.52, 0.42], [0.20, 0.25, 0.45]) + rng.normal(0, 0.05, (count, 3))
    normals = _unit(directions / axes) + rng.normal(0, 0.2, (count, 3))
    return means, normals, rng.normal(size=(count, 3)), _discs(rng, count, 1.4 * base), colors


def _discs(rng: np.random.Generator, count: int, base: float) -> np.ndarray:
    """[N, 3] m: lognormal size and aspect, a quarter as thick."""
    size, aspect = base * np.exp(rng.normal(0, 0.55, count)), np.exp(rng.normal(0, 0.25, count))
    return np.stack([size * aspect, size / aspect, 0.25 * size], 1)


def _trained_opacities(rng: np.random.Generator, count: int) -> np.ndarray:
    """A third faint, a third middling, a third solid, as trained avatars have them."""
    kinds = rng.choice(3, count, p=[0.35, 0.35, 0.3])
    mixed = np.choose(kinds, [rng.beta(0.7, 6, count), rng.beta(1.2, 1.2, count), rng.beta(9, 0.9, count)])
    return np.clip(mixed, 0.0055, 0.9995)


def _gaussians(
    rng: np.random.Generator,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
) -> Gaussians:
    """Shuffled (trained files have no spatial order), with noise as SH of degree 3."""
    order = rng.permutation(len(means))
    noise = rng.normal(size=(len(means), 15, 3)) * SH_SIGMAS[:, None]
    dc = (np.clip(colors, 0.01, 0.99) - 0.5) / SH_DC
    sh = np.concatenate([dc[:, None], noise], 1)
    return Gaussians(
        *(np.ascontiguousarray(x[order], np.float32) for x in (means, quats, scales, opacities, sh))
    )


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    return _unit(rng.normal(size=(count, 3)))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _quats(normals: np.ndarray, along: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz: the third axis along the normal, the first as near to `along` as that allows."""
    third = _unit(normals)
    first = _unit(along - (along * third).sum(1, keepdims=True) * third)
    return rotmat_to_quat(np.stack([first, np.cross(third, first), third], -1))
