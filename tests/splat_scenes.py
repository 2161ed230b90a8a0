"""Small clouds of Gaussians with every awkward case on purpose, for the tests of splatting."""

from __future__ import annotations

import numpy as np

from cap4d.camera import Camera, orbit_camera
from cap4d.gaussians import Gaussians


def view(width: int = 61, height: int = 45, *, yaw_deg: float = 20.0, fov_y_deg: float = 25.0) -> Camera:
    """A camera 1 m from the origin; sizes that are no multiple of anything, off-centre by a little."""
    camera = orbit_camera(
        yaw_deg=yaw_deg,
        pitch_deg=10.0,
        distance=1.0,
        target=np.zeros(3),
        fov_y_deg=fov_y_deg,
        width=width,
        height=height,
    )
    K = camera.K.copy()
    K[0, 0] *= 1.1
    K[:2, 2] += [1.3, -0.7]
    return Camera(K, camera.viewmat, width, height)


def cloud(
    count: int = 200, *, seed: int = 0, size: float = 0.02, degree: int = 3, spread: float = 0.08
) -> Gaussians:
    """Random Gaussians around the origin: needles and discs, faint and solid, quaternions of any norm.

    Args:
        size: Median scale, m.
        spread: Standard deviation of the means, m.
    """
    rng = np.random.default_rng(seed)
    fields = (
        rng.normal(0, spread, (count, 3)),
        rng.normal(size=(count, 4)) * np.exp(rng.normal(0, 1, (count, 1))),
        size * np.exp(rng.normal(0, 0.8, (count, 3))),
        np.clip(rng.beta(0.8, 0.8, count), 0.006, 0.999),
        rng.normal(0, 0.3, (count, (degree + 1) ** 2, 3)),
    )
    return Gaussians(*(np.ascontiguousarray(x, np.float32) for x in fields))


def needles(count: int = 6, *, sigma: float = 300.0, thickness: float = 0.3) -> tuple[Gaussians, Camera]:
    """Diagonals across 512 px, both ways and nearly so: in float32 their conics multiplied out cancel.

    Args:
        sigma: Standard deviation along the needle, px.
        thickness: Across it, before the low-pass, px.
    """
    size = 512
    K = np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]])
    camera = Camera(K, np.eye(4), size, size)
    rng = np.random.default_rng(10)
    angles = np.pi / 4 + np.arange(count) * np.pi / 2 + rng.normal(0, 0.05, count)
    half = angles[:, None] / 2
    means = np.concatenate([rng.normal(0, 0.02, (count, 2)), 1 + 0.1 * np.arange(count)[:, None]], 1)
    pixels_to_metres = means[:, 2:] / size
    fields = (
        means,
        np.concatenate([np.cos(half), np.zeros((count, 2)), np.sin(half)], 1),
        np.array([[sigma, thickness, thickness]]) * pixels_to_metres,
        rng.uniform(0.5, 0.95, count),
        rng.normal(0, 0.3, (count, 4, 3)),
    )
    return Gaussians(*(np.ascontiguousarray(x, np.float32) for x in fields)), camera


SCENES = {
    "mixed": lambda: (cloud(), view()),
    "fine": lambda: (cloud(400, seed=1, size=0.002), view()),
    "coarse": lambda: (cloud(80, seed=2, size=0.08), view()),
    "solid": lambda: (solid(cloud(300, seed=3)), view()),
    "wide": lambda: (cloud(300, seed=4, spread=0.6), view(fov_y_deg=70.0)),
    "one_pixel": lambda: (cloud(50, seed=5), view(1, 1)),
    "one_row": lambda: (cloud(seed=6), view(130, 1)),
    "degree_0": lambda: (cloud(seed=7, degree=0), view()),
    "degree_1": lambda: (cloud(seed=8, degree=1), view()),
    "degree_2": lambda: (cloud(seed=9, degree=2), view()),
    "needles": needles,
    "many": lambda: (cloud(4000, seed=11, size=0.001, degree=1), view()),  # several pieces of work
}


def solid(gaussians: Gaussians) -> Gaussians:
    """The same with opacities near 1: pixels end early and alpha is clamped."""
    opacities = 1 - 0.03 * gaussians.opacities
    return Gaussians(
        gaussians.means, gaussians.quats, gaussians.scales, opacities.astype(np.float32), gaussians.sh
    )
