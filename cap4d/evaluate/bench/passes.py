"""The ways of splatting that are measured, each ready to be called again and again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cap4d import _core
from cap4d.evaluate.bench.scenes import Scene

PASSES = ("forward", "stateless", "forward_backward")
STAGES = ("project", "sort", "tiles", "rasterize")
LANES = {"base": 4, "v3": 8, "v4": 16}


def lanes() -> int:
    """Floats in a register of the instruction set in use."""
    return LANES[_core.isa()]


class Playing:
    """Drawing for the eye as a player does: Gaussians prepared once (colours in float16), buffers kept.

    Calling it draws; `seconds` collects what each stage of each call took.
    """

    def __init__(self, scene: Scene, *, threads: int) -> None:
        self._splatter = _core.Splatter(*scene.fields)
        self._view, self._threads = scene.view, threads
        self.seconds: list[dict[str, float]] = []

    def __call__(self) -> tuple[np.ndarray, ...]:
        image = self._splatter.render(*self._view, threads=self._threads)
        self.seconds.append(self._splatter.seconds)
        return image

    def stage_ms(self) -> dict[str, float]:
        """Median milliseconds of each stage."""
        return {
            stage: round(1e3 * float(np.median([seconds[stage] for seconds in self.seconds])), 4)
            for stage in STAGES
        }


def stateless(scene: Scene, *, threads: int) -> Callable[[], Any]:
    """Drawing Gaussians that may be others each time, in single precision."""
    return lambda: _core.render(*scene.fields, *scene.view, None, -1, threads)


def forward_backward(scene: Scene, *, threads: int) -> Callable[[], Any]:
    """One step's splatting in fitting: the picture, then the gradients of means, quats, scales, opacities,
    sh and means2d for a fixed random gradient of the colours.
    """
    v_rgb = random_gradient(scene)

    def step() -> Any:
        rgb, alpha, depth, _, _, rendered = _core.rasterize(*scene.fields, *scene.view, None, -1, threads)
        return _core.rasterize_vjp(rendered, *scene.fields, -1, rgb, alpha, depth, v_rgb, None, None, threads)

    return step


def random_gradient(scene: Scene) -> np.ndarray:
    """float32[H, W, 3] dL/d(colours), the same each time."""
    shape = (scene.camera.height, scene.camera.width, 3)
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


def passes(scene: Scene, *, threads: int) -> dict[str, Callable[[], Any]]:
    """Ready to be timed, by the names of `PASSES`."""
    makers = (Playing, stateless, forward_backward)
    return {name: make(scene, threads=threads) for name, make in zip(PASSES, makers, strict=True)}
