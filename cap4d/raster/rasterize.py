"""The differentiable entry point: checks the arguments, picks the backend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from cap4d.camera import Camera
from cap4d.errors import ArgumentError
from cap4d.gaussians import SH_COUNTS

Backend = Literal["auto", "cpu", "gsplat", "reference"]


@dataclass(frozen=True, eq=False)
class Rasterized:
    """A differentiable picture of Gaussians.

    Args:
        rgb: [H, W, 3] composited on the background (premultiplied by alpha without one).
        alpha: [H, W] coverage.
        depth: [H, W] expected depth, m; 0 where alpha is 0.
        means2d: [N, 2] image positions, px (0 where not drawn). After `backward`, its `.grad` is
            dL/d(position), which densification reads. Nothing flows back through the values themselves.
        radii: int32[N] three standard deviations, px, rounded up; 0 for a Gaussian that is not drawn.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    means2d: Tensor
    radii: Tensor


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    *,
    camera: Camera,
    background: Sequence[float] | None = None,
    sh_degree: int | None = None,
    backend: Backend = "auto",
    threads: int = 0,
) -> Rasterized:
    """Splats Gaussians (Kerbl et al. 2023), with gradients to means, quats, scales, opacities and sh.

    Args:
        means: [N, 3] m, world.
        quats: [N, 4] wxyz, any norm.
        scales: [N, 3] m.
        opacities: [N] in [0, 1].
        sh: [N, S, 3], S = 1, 4, 9 or 16, DC first.
        camera: Where from.
        background: sRGB, or None for premultiplied colour.
        sh_degree: Evaluate only degrees up to this one; None: all that `sh` holds.
        backend: "auto" is "gsplat" for CUDA tensors and "cpu" otherwise.
        threads: Of the C++ renderer; 0 uses all cores (or CAP4D_THREADS). Never changes a bit of the result.
    Raises:
        ArgumentError: A shape, dtype or the backend does not fit.
    """
    _check(means, quats, scales, opacities, sh, sh_degree)
    degree = SH_COUNTS[sh.shape[1]] if sh_degree is None else sh_degree
    colour = None if background is None else tuple(map(float, background))
    gaussians = (means, quats, scales, opacities, sh)
    if backend == "auto":
        backend = "gsplat" if means.is_cuda else "cpu"
    if backend == "cpu":
        from cap4d.raster.cpu import rasterize_cpu

        return rasterize_cpu(*gaussians, camera=camera, background=colour, sh_degree=degree, threads=threads)
    if backend == "gsplat":
        from cap4d.raster.cuda import rasterize_gsplat

        return rasterize_gsplat(*gaussians, camera=camera, background=colour, sh_degree=degree)
    if backend == "reference":
        from cap4d.raster.reference import rasterize_reference

        return rasterize_reference(*gaussians, camera=camera, background=colour, sh_degree=degree)
    raise ArgumentError(f"backend: expected auto, cpu, gsplat or reference, got {backend}")


def _check(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, sh_degree: int | None
) -> None:
    n = len(means)
    fields = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
    }
    for name, (value, shape) in fields.items():
        if tuple(value.shape) != shape or not torch.is_floating_point(value):
            raise ArgumentError(f"{name}: expected float{list(shape)}, got {value.dtype}{list(value.shape)}")
    if sh.ndim != 3 or sh.shape[0] != n or sh.shape[1] not in SH_COUNTS or sh.shape[2] != 3:
        raise ArgumentError(f"sh: expected float[{n}, 1|4|9|16, 3], got {sh.dtype}{list(sh.shape)}")
    if sh_degree is not None and not 0 <= sh_degree <= SH_COUNTS[sh.shape[1]]:
        raise ArgumentError(f"sh_degree: expected 0 to {SH_COUNTS[sh.shape[1]]}, got {sh_degree}")


def collecting_leaf(positions: Tensor, ids: Tensor, count: int) -> Tensor:
    """`Rasterized.means2d` of a backend whose positions are part of the graph.

    Args:
        positions: [..., V, 2] px; its gradient is copied as it passes.
        ids: int64[V], rows of the result.
        count: N.
    Returns:
        [N, 2] leaf with the positions, zero elsewhere.
    """
    leaf = positions.new_zeros(count, 2)
    leaf[ids] = positions.detach().reshape(-1, 2)
    if positions.requires_grad:
        leaf.requires_grad_()

        def collect(v_positions: Tensor) -> None:
            grad = torch.zeros_like(leaf)
            grad[ids] = v_positions.reshape(-1, 2)
            leaf.grad = grad if leaf.grad is None else leaf.grad + grad

        positions.register_hook(collect)
    return leaf
