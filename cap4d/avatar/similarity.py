"""Two images in one pass of C++: mean absolute difference and SSIM, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cap4d import _core


def l1_and_ssim(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean structural similarity of two images.

    SSIM is that of `cap4d.avatar.losses.ssim_map`. The same bits for any number of threads.

    Args:
        image, target: float32[H, W, C] in [0, 1], on the CPU. Only the image gets a gradient.
    Returns:
        Two scalars; of the first the derivative at equal values is 0.
    """
    return _Similarity.apply(image, target)


class _Similarity(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        absolute, structural, partials = _core.similarity(_array(image), _array(target))
        ctx.save_for_backward(image, target)
        ctx.partials = partials
        return image.new_tensor(absolute), image.new_tensor(structural)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_absolute: Tensor, v_structural: Tensor) -> tuple[Tensor, None]:
        image, target = map(_array, ctx.saved_tensors)
        v_image = _core.similarity_vjp(image, target, ctx.partials, v_absolute.item(), v_structural.item())
        return torch.from_numpy(v_image), None


def _array(x: Tensor) -> Any:
    return x.detach().contiguous().numpy()
