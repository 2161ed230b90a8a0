"""Clouds and cameras at the edge of what float32 and the maths of splatting bear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from splat_scenes import cloud, view

from cap4d.camera import Camera
from cap4d.gaussians import Gaussians

Scene = tuple[Gaussians, Camera]

SIZE = 48  # px


def frontal(
    width: int = SIZE, height: int = SIZE, *, focal: float = 60.0, x: float = 0, y: float = 0
) -> Camera:
    """At the origin, looking along z, so that a mean's z is its depth to the last bit.

    Args:
        x, y: px, how far the principal point is from the middle.
    """
    K = np.array([[focal, 0, width / 2 + x], [0, focal, height / 2 + y], [0, 0, 1]])
    return Camera(K, np.eye(4), width, height)


def gaussians(**fields: object) -> Gaussians:
    """Gaussians from lists; a field that is one row (or one number) is that of all."""
    n = len(np.atleast_2d(np.asarray(fields["means"])))
    arrays = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "sh": (n, *np.shape(fields["sh"])[-2:]),
    }
    wide = {k: np.broadcast_to(np.asarray(fields[k], np.float64), shape) for k, shape in arrays.items()}
    return Gaussians(**{k: np.ascontiguousarray(v, np.float32) for k, v in wide.items()})


def in_front(count: int, *, seed: int, depth: tuple[float, float] = (0.5, 2.0), spread: float = 0.35) -> dict:
    """Fields of `count` Gaussians before `frontal`, 2 cm large, of every colour and direction."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, count)
    return {
        "means": np.concatenate([rng.normal(0, spread, (count, 2)), np.ones((count, 1))], 1) * z[:, None],
        "quats": rng.normal(size=(count, 4)),
        "scales": 0.02 * np.exp(rng.normal(0, 0.5, (count, 3))),
        "opacities": rng.uniform(0.1, 0.95, count),
        "sh": rng.normal(0, 0.2, (count, 4, 3)),
    }


def near_plane() -> Scene:
    """Centres behind the camera, one step of float32 before and behind the near plane, and reaching through
    it.
    """
    near = np.float32(0.01)
    z = [
        -1.0,
        -0.01,
        -1e-6,
        0.0,
        1e-6,
        0.009,
        np.nextafter(near, np.float32(0)),
        np.nextafter(near, np.float32(1)),
    ]
    z += [0.0101, 0.011, 0.015, 0.02, 0.05, 0.1, 0.3]
    fields = in_front(len(z), seed=20, spread=0.3)
    fields["means"][:, 2] = 1
    fields["means"] = fields["means"] * np.array(z)[:, None]
    fields["scales"] = np.array([1e-4, 1e-3, 1e-2, 0.1, 0.3])[np.arange(len(z)) % 5, None] * [1, 0.7, 1.3]
    fields["opacities"] = np.full(len(z), 0.4)
    return gaussians(**fields), frontal()


def behind() -> Scene:
    """All of it is behind the camera."""
    fields = in_front(30, seed=21)
    fields["means"] = -fields["means"]
    return gaussians(**fields), frontal()


def scaled(sizes: list[float], *, seed: int, opacity: float = 0.3) -> Scene:
    """Every scale one of `sizes`, in every mixture: balls, needles and discs of all directions."""
    fields = in_front(60, seed=seed)
    rng = np.random.default_rng(seed)
    fields["scales"] = rng.choice(sizes, (60, 3))
    fields["opacities"] = rng.uniform(0.5, 1, 60) * opacity
    return gaussians(**fields), frontal()


def colossal() -> Scene:
    """A kilometre large, through a lens of 1 degree at 512 px: standard deviations near 4e9 px, all that
    float32 can square twice.
    """
    fields = in_front(60, seed=44, depth=(0.01, 2), spread=0.3)
    rng = np.random.default_rng(44)
    fields["scales"] = 1e3 * rng.choice([1e-15, 1e-6, 0.1, 1.0], (60, 3))
    return gaussians(**fields | {"opacities": rng.uniform(0.02, 0.1, 60)}), frontal(focal=29e3)


def covering() -> Scene:
    """One Gaussian, a million times as wide as the image."""
    return gaussians(
        means=[0.1, 0, 1], quats=[4, 1, 2, 3], scales=[1e6, 2e6, 5e5], opacities=0.8, sh=[[0.4] * 3]
    ), frontal()


def layers(count: int = 1000) -> Scene:
    """As many layers at one depth, each of its own colour: what is drawn first decides the picture."""
    rng = np.random.default_rng(23)
    return gaussians(
        means=np.concatenate([rng.normal(0, 0.05, (count, 2)), np.ones((count, 1))], 1),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.05, 0.2, (count, 3)),
        opacities=rng.uniform(0.004, 0.05, count),
        sh=rng.normal(0, 1, (count, 1, 3)),
    ), frontal()


def saturated() -> Scene:
    """Opacities about and beyond the clamp at 0.99, up to what float32 holds."""
    opacities = [0.9, 0.989, 0.9899, 0.9901, 0.999, 1.0, 1.5, 1e4, 1e30, 3.4e38, 0.5, 0.7]
    fields = in_front(len(opacities), seed=24, spread=0.3)
    return gaussians(**fields | {"scales": [0.03, 0.05, 0.07], "opacities": opacities}), frontal()


def opaque() -> Scene:
    """300 layers that let half through: transmittance would underflow 2^-126 were pixels not ended."""
    rng = np.random.default_rng(25)
    fields = in_front(300, seed=25, depth=(0.5, 3), spread=0.1)
    return gaussians(
        **fields | {"scales": [1.0, 2.0, 3.0], "opacities": rng.uniform(0.3, 0.7, 300)}
    ), frontal()


def quaternions() -> Scene:
    """Norms from nothing to what float32 holds, and half turns."""
    norms = [0, 1e-45, 1e-38, 1e-20, 0.9e-12, 1.1e-12, 1e-6, 1, 1e6, 1e19, 1e20, 1e30, 1.7e38, 3.4e38]
    fields = in_front(4 * len(norms), seed=26)
    unit = fields["quats"] / np.abs(fields["quats"]).max(1, keepdims=True)
    unit[::4, 0] = 0  # half turns
    unit[1::4, 0] = 1e-7
    unit[2::4, 1:] *= 1e-6  # hardly a turn
    return gaussians(**fields | {"quats": unit * np.repeat(norms, 4)[:, None]}), frontal()


def far_away() -> Scene:
    """The whole scene, and its camera, 10 km from the origin."""
    scene, camera = cloud(150, seed=27, size=0.02), view(SIZE, SIZE)
    shift = np.array([6e3, -5e3, 6e3])
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift
    return replace(scene, means=(scene.means + shift).astype(np.float32)), replace(camera, viewmat=viewmat)


def distant() -> Scene:
    """Near the origin, seen from 10 km through a long lens: 13 steps of float32 between depths."""
    K = np.array([[4e6, 0, SIZE / 2], [0, 4e6, SIZE / 2], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[2, 3] = 1e4
    scene = cloud(150, seed=28, size=0.01, spread=0.03)
    means = scene.means.copy()
    means[:, 2] = np.linspace(-1, 1, 150)[np.random.default_rng(28).permutation(150)]
    return replace(scene, means=means), Camera(K, viewmat, SIZE, SIZE)


def denormal() -> Scene:
    """Numbers below 2^-126 in every field."""
    fields = in_front(40, seed=29)
    fields["means"][::4, 0] = 1e-40
    fields["quats"][1::4, 1:3] = [1e-40, -1e-44]
    fields["scales"][2::4] = [1e-45, 1e-40, 0.02]
    fields["sh"][3::4, 1:] = -1e-42
    fields["opacities"][::5] = 1e-40
    return gaussians(**fields), frontal()


def bright() -> Scene:
    """Spherical harmonics beyond float16 (65504), below what counts as bad data."""
    fields = in_front(40, seed=30)
    return gaussians(**fields | {"sh": fields["sh"] * 1e6}), frontal()


def fov_1() -> Scene:
    """One degree: a focal length of 2750 px, from far away."""
    camera = view(SIZE, SIZE, fov_y_deg=1.0)
    return cloud(150, seed=31, size=0.001, spread=0.003), camera


def fov_170() -> Scene:
    """170 degrees: the Jacobian varies over the image, and is clamped where it would run away."""
    fields = in_front(150, seed=32, spread=4.0, depth=(0.05, 1))
    return gaussians(**fields | {"scales": fields["scales"] * 3}), frontal(
        focal=SIZE / 2 / np.tan(np.radians(85))
    )


def off_centre() -> Scene:
    """The principal point 20 images away, as of a crop."""
    camera = frontal(x=-20 * SIZE, y=13 * SIZE)
    fields = in_front(150, seed=33)
    fields["means"] += fields["means"][:, 2:] * np.array([20, -13, 0]) * SIZE / 60
    return gaussians(**fields), camera


def one_pixel() -> Scene:
    return gaussians(**in_front(40, seed=34, spread=0.02)), frontal(1, 1)


def strip(width: int, height: int) -> Scene:
    """As wide as large images are, with few rows: few pixels, large coordinates."""
    fields = in_front(40, seed=35, spread=0.3)
    longer = np.array([width, height, 0]) / max(width, height)
    fields["means"] = fields["means"] * longer + fields["means"] * [0, 0, 1]
    return gaussians(**fields), frontal(width, height, focal=float(max(width, height)))


def scene_around(victim: int) -> Scene:
    """20 Gaussians of degree 3 about one that is straight ahead, where most basis functions are 0."""
    clouds, camera = cloud(20, seed=50), frontal(33, 29, focal=70.0)
    means = clouds.means + np.float32([0, 0, 1])
    means[victim] = [0, 0, 0.3]
    return Gaussians(means, clouds.quats, clouds.scales, clouds.opacities, clouds.sh), camera


SCENES: dict[str, Callable[[], Scene]] = {
    "near_plane": near_plane,
    "behind": behind,
    "tiny": lambda: scaled([1e-12, 1e-9, 1e-6, 1e-3], seed=40, opacity=0.9),
    "singular": lambda: scaled([1e-12, 1e-6, 0.02, 0.2], seed=41),
    "enormous": lambda: scaled([10.0, 100.0, 1e3], seed=42, opacity=0.1),
    "colossal": colossal,
    "every_scale": lambda: scaled([1e-12, 1e-4, 0.02, 1.0, 1e3], seed=43, opacity=0.2),
    "covering": covering,
    "layers": layers,
    "saturated": saturated,
    "opaque": opaque,
    "quaternions": quaternions,
    "far_away": far_away,
    "distant": distant,
    "denormal": denormal,
    "bright": bright,
    "fov_1": fov_1,
    "fov_170": fov_170,
    "off_centre": off_centre,
    "one_pixel": one_pixel,
    "wide_8192": lambda: strip(8192, 6),
    "high_8192": lambda: strip(6, 8192),
}
