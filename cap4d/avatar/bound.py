"""Posed Gaussians from vertices as a torch operator: the C++ form of `bind`, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cap4d import _core
from cap4d.bind import bind, triangle_frames


def bind_to(
    vertices: Tensor, faces: Tensor, *, means: Tensor, quats: Tensor, log_scales: Tensor, binding: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`bind(triangle_frames(vertices, faces), ...)` of cap4d.bind, fact 27: in C++ on the CPU.

    Elsewhere with torch's own gradients, of frames in double as in C++.

    Args:
        vertices: float32[G, 3] m.
        faces: int32[M, 3].
        means, quats, log_scales: float32[N, 3], [N, 4], [N, 3], local to the triangles.
        binding: int32[N] into faces.
    Returns:
        means [N, 3] m, quats [N, 4], scales [N, 3] m. Triangles without area give no gradient to their
        frames.
    """
    if vertices.device.type == "cpu":
        return _Bind.apply(vertices, means, quats, log_scales, faces, binding)
    return bind_in_torch(vertices, faces, means=means, quats=quats, log_scales=log_scales, binding=binding)


def bind_in_torch(
    vertices: Tensor, faces: Tensor, *, means: Tensor, quats: Tensor, log_scales: Tensor, binding: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`bind_to` on any device. The gradient of a triangle without area is finite, but may be large."""
    frames = tuple(x.to(means.dtype) for x in triangle_frames(vertices.double(), faces.long()))
    return bind(frames, means=means, quats=quats, log_scales=log_scales, binding=binding.long())


class _Bind(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        vertices: Tensor,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        faces: Tensor,
        binding: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(vertices, means, quats, log_scales, faces, binding)
        posed = _core.bind(*(_array(x) for x in (vertices, faces, means, quats, log_scales, binding)))
        return tuple(map(torch.from_numpy, posed))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_means: Tensor, v_quats: Tensor, v_scales: Tensor) -> tuple[Tensor | None, ...]:
        vertices, means, quats, log_scales, faces, binding = ctx.saved_tensors
        inputs = (vertices, faces, means, quats, log_scales, binding, v_means, v_quats, v_scales)
        gradients = _core.bind_vjp(*map(_array, inputs))
        return (*map(torch.from_numpy, gradients), None, None)


def _array(x: Tensor) -> Any:
    return x.detach().contiguous().numpy()
