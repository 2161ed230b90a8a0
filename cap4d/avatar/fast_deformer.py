"""The deformation network in C++ while it is fitted: there and back in one operator, on the CPU.

A step of fitting is a batch of two passes through a small network: torch's convolutions spend half their time
on changing layouts, and give other bits on other numbers of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cap4d import _core


class FastDeformer:
    """Runs the layers of one network; keeps the memory of passes that are over for the next ones.

    Args:
        width: First-layer channels.
        encoding: float32[C, S, S] what the first layer sees behind the three offsets.
    """

    def __init__(self, width: int, encoding: Tensor) -> None:
        self.width, self.encoding = width, encoding.detach().contiguous().numpy()
        self._idle: list[_core.UnetPass] = []

    def __call__(self, offsets: Tensor, down: Sequence[Tensor], up: Sequence[Tensor]) -> Tensor:
        """[B, 3, S, S] scaled and masked offsets -> what the network answers.

        Args:
            offsets: float32, without a gradient.
            down, up: float32 weights and biases in turns, the outermost layer first.
        """
        comes_back = torch.is_grad_enabled() and any(x.requires_grad for x in (*down, *up))
        return _Pass.apply(self, offsets, len(down), comes_back, *down, *up)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles are without the memory."""
        return FastDeformer, (self.width, torch.from_numpy(self.encoding))

    def take(self, batch: int) -> _core.UnetPass:
        """A pass that nobody is on."""
        for i, idle in enumerate(self._idle):
            if idle.batch == batch:
                return self._idle.pop(i)
        return _core.UnetPass(self.width, batch, self.encoding)

    def give_back(self, used: _core.UnetPass) -> None:
        self._idle.append(used)


class _Pass(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, network: FastDeformer, offsets: Tensor, split: int, comes_back: bool, *tensors: Tensor
    ) -> Tensor:
        arrays = [x.detach().contiguous().numpy() for x in tensors]
        run = network.take(len(offsets))
        down, up = _pairs(arrays[:split]), _pairs(arrays[split:])
        out = torch.from_numpy(run.forward(offsets.detach().contiguous().numpy(), down, up))
        if comes_back:
            ctx.network, ctx.run = network, run
        else:
            network.give_back(run)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.run is None:
            raise RuntimeError("the gradient of a pass can be taken once")
        down, up = ctx.run.backward(v_out.contiguous().numpy())
        ctx.network.give_back(ctx.run)
        ctx.run = None
        gradients = (torch.from_numpy(x) for pair in (*down, *up) for x in pair)
        return (None, None, None, None, *gradients)


def _pairs(arrays: Sequence[Any]) -> list[tuple[Any, Any]]:
    return list(zip(arrays[::2], arrays[1::2], strict=True))
