"""Posed Gaussians to a picture, on the CPU: the forward pass alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cap4d import _core
from cap4d.camera import Camera
from cap4d.gaussians import Gaussians

WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Rendered:
    """A picture of Gaussians.

    Args:
        rgb: float32[H, W, 3] sRGB composited on the background (premultiplied by alpha without one).
        alpha: float32[H, W] coverage.
        depth: float32[H, W] expected depth, m; 0 where alpha is 0.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


def render(
    gaussians: Gaussians, camera: Camera, *, background: Sequence[float] | None = WHITE, threads: int = 0
) -> Rendered:
    """Splats Gaussians (Kerbl et al. 2023) with the tiled C++ renderer.

    EWA projection with a low-pass of 0.3 px^2; alpha = min(0.99, opacity * density); contributions
    below 1/255 are skipped; a pixel ends before its transmittance would fall below 1e-4. A Gaussian with
    a non-finite field is not drawn. The picture has the same bits for any number of threads.

    Args:
        gaussians: N Gaussians in world space, m.
        camera: Where from.
        background: sRGB, or None for premultiplied colour.
        threads: 0 uses all cores (or CAP4D_THREADS).
    """
    arrays = (
        np.ascontiguousarray(a)
        for a in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    )
    colour = None if background is None else tuple(map(float, background))
    return Rendered(
        *_core.render(*arrays, camera.viewmat, camera.K, camera.width, camera.height, colour, -1, threads)
    )
