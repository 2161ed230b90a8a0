"""The C++ renderer as a torch operator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cap4d import _core
from cap4d.camera import Camera
from cap4d.raster.rasterize import Rasterized


def rasterize_cpu(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    *,
    camera: Camera,
    background: tuple[float, ...] | None,
    sh_degree: int,
    threads: int,
) -> Rasterized:
    """`rasterize` on the CPU in float32; the arguments are those of `rasterize`, checked."""
    gaussians = tuple(x.to(device="cpu", dtype=torch.float32) for x in (means, quats, scales, opacities, sh))
    # A leaf that only collects a gradient: its values are written by the forward pass.
    means2d = torch.zeros(
        len(means), 2, requires_grad=torch.is_grad_enabled() and any(x.requires_grad for x in gaussians)
    )
    settings = (camera.viewmat, camera.K, camera.width, camera.height, background, sh_degree, threads)
    rgb, alpha, depth, radii = _Rasterize.apply(*gaussians, means2d, settings)
    return Rasterized(rgb, alpha, depth, means2d, radii)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        means2d: Tensor,
        settings: tuple,
    ) -> Any:
        gaussians = (means, quats, scales, opacities, sh)
        *outputs, positions, radii, rendered = _core.rasterize(*map(_array, gaussians), *settings)
        means2d.data.copy_(torch.from_numpy(positions))
        rgb, alpha, depth = map(torch.from_numpy, outputs)
        ctx.save_for_backward(*gaussians, rgb, alpha, depth)
        ctx.rendered, ctx.sh_degree, ctx.threads = rendered, *settings[-2:]
        radii = torch.from_numpy(radii)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return rgb, alpha, depth, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, v_rgb: Tensor | None, v_alpha: Tensor | None, v_depth: Tensor | None, _: None
    ) -> Any:
        *gaussians, rgb, alpha, depth = ctx.saved_tensors
        v_rgb = torch.zeros_like(rgb) if v_rgb is None else v_rgb
        optional = (None if v is None else _array(v) for v in (v_alpha, v_depth))
        grads = _core.rasterize_vjp(
            ctx.rendered,
            *map(_array, gaussians),
            ctx.sh_degree,
            *map(_array, (rgb, alpha, depth, v_rgb)),
            *optional,
            ctx.threads,
        )
        return *map(torch.from_numpy, grads), None


def _array(x: Tensor) -> np.ndarray:
    return x.detach().contiguous().numpy()
