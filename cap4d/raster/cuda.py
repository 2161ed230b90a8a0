"""gsplat (Ye et al. 2024) behind the same call, for CUDA tensors. Not a dependency of the package."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cap4d.camera import NEAR, Camera
from cap4d.errors import ArgumentError
from cap4d.raster.rasterize import Rasterized, collecting_leaf
from cap4d.raster.reference import EPS2D

FAR = 1e3  # m; what the released CAP4D passes (fact 39)


def rasterize_gsplat(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    *,
    camera: Camera,
    background: tuple[float, ...] | None,
    sh_degree: int,
) -> Rasterized:
    """`rasterize` with gsplat in float32; the arguments are those of `rasterize`, checked.

    Raises:
        ArgumentError: gsplat is not installed, or the tensors are not on a CUDA device.
    """
    rasterization = _rasterization()
    if not means.is_cuda:
        raise ArgumentError(f"backend gsplat: expected CUDA tensors, got {means.device}")
    gaussians = [x.float() for x in (means, quats, scales, opacities, sh)]
    viewmat, K = (
        torch.tensor(x, dtype=torch.float32, device=means.device) for x in (camera.viewmat, camera.K)
    )
    images, alphas, meta = rasterization(
        *gaussians,
        viewmats=viewmat[None],
        Ks=K[None],
        width=camera.width,
        height=camera.height,
        near_plane=NEAR,
        far_plane=FAR,
        eps2d=EPS2D,
        sh_degree=sh_degree,
        packed=False,
        render_mode="RGB+ED",
    )
    rgb, depth, alpha = images[0, ..., :3], images[0, ..., 3], alphas[0, ..., 0]
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * rgb.new_tensor(background)
    radii = meta["radii"][0]
    if radii.ndim == 2:  # gsplat 1.5 gives one per axis
        radii = radii.amax(1)
    ids = torch.arange(len(means), device=means.device)
    means2d = collecting_leaf(meta["means2d"], ids, len(means))
    return Rasterized(rgb, alpha, depth, means2d, radii.int())


def _rasterization() -> Any:
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise ArgumentError("backend gsplat: gsplat is not installed (pip install gsplat)") from error
    return rasterization
