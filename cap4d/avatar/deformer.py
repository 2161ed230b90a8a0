"""The deformation U-Net: expression offsets on the UV grid in, a correction of the grid's vertices out.

The architecture is pix2pix's generator (Isola et al. 2017) with the sizes and names of the released CAP4D
weights (facts 20-25), so that their `deform_net` state dicts load as they stand.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import nn

from cap4d.avatar.fast_deformer import FastDeformer

DEFORM_STD = (
    0.0108  # m; offsets are divided by it on the way in, the output is multiplied by it (facts 20, 23)
)
ENCODING_FREQUENCIES = 6  # powers of two from 2^0, without pi (fact 21)
ENCODING_CHANNELS = 2 * 2 * ENCODING_FREQUENCIES
MAX_DOWNSAMPLINGS = 6  # 128 px -> 2 px
INIT_STD = 0.02


class Deformer(nn.Module):
    """Expression offsets [B, 3, S, S] m -> deformation [B, 3, S, S] m in the posed head frame (facts 20-23).

    It starts at zero deformation: the last layer's weight and bias are zero.

    Args:
        valid: bool[S, S] grid pixels that carry a vertex; offsets elsewhere are masked out.
        width: Channels of the first layer (`ngf`); the released nets have 64.
        generator: Source of the random initial weights.
    """

    def __init__(
        self, valid: np.ndarray, *, width: int = 64, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        size = len(valid)
        self.size, self.width = size, width
        self.model = _Level.outermost(3 + ENCODING_CHANNELS, 3, width, downsamplings(size))
        mask = torch.from_numpy(np.ascontiguousarray(valid, np.float32))
        self.register_buffer("mask", mask, persistent=False)
        self.register_buffer("encoding", positional_encoding(size), persistent=False)
        self._fast: FastDeformer | None = None
        self._initialise(generator)

    def forward(self, offsets: torch.Tensor) -> torch.Tensor:
        scaled = offsets * (self.mask / DEFORM_STD)
        if _is_fast(scaled, self.encoding):
            return self._run_fast(scaled) * DEFORM_STD
        encoding = self.encoding.expand(len(offsets), -1, -1, -1)
        return self.model(torch.cat([scaled, encoding], 1)) * DEFORM_STD

    def _run_fast(self, scaled: torch.Tensor) -> torch.Tensor:
        if self._fast is None:
            self._fast = FastDeformer(self.width, self.encoding)
        down, up = self.model.tensors()
        return self._fast(scaled, down, up)

    def _initialise(self, generator: torch.Generator | None) -> None:
        """N(0, 0.02) weights, zero biases, and a zero last layer (fact 23)."""
        for name, parameter in self.named_parameters():
            if name.endswith("bias"):
                nn.init.zeros_(parameter)
            else:
                nn.init.normal_(parameter, std=INIT_STD, generator=generator)
        last = self.model.model[-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)


class _Level(nn.Module):
    """One resolution of the U-Net with everything below it: halve, recurse, double, and skip around.

    `model` is a flat Sequential because its indices are the names in the released state dicts.
    """

    def __init__(self, layers: list[nn.Module], *, skip: bool) -> None:
        super().__init__()
        self.model = nn.Sequential(*layers)
        self.skip = skip

    @classmethod
    def outermost(cls, inputs: int, outputs: int, width: int, depth: int) -> _Level:
        below = cls.inner(width, width, 1, depth)
        up = _up(2 * width if depth > 1 else width, outputs)
        return cls([_down(inputs, width), below, nn.ReLU(), up], skip=False)

    @classmethod
    def inner(cls, inputs: int, width: int, level: int, depth: int) -> _Level:
        """Level `level` of `depth` (0 is the outermost); channels double until 8 x width (fact 22)."""
        channels = width * min(2**level, 8)
        if (
            level == depth - 1
        ):  # innermost: nothing below, and one value per pixel pair leaves nothing to normalise
            layers = [
                nn.LeakyReLU(0.2),
                _down(inputs, channels),
                nn.ReLU(),
                _up(channels, inputs),
                _norm(inputs),
            ]
            return cls(layers, skip=True)
        below = cls.inner(channels, width, level + 1, depth)
        return cls(
            [
                nn.LeakyReLU(0.2),
                _down(inputs, channels),
                _norm(channels),
                below,
                nn.ReLU(),
                _up(2 * channels, inputs),
                _norm(inputs),
            ],
            skip=True,
        )

    def tensors(self) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Weights and biases in turns on the way down, and on the way up; the outermost layer first."""
        below = next((layer for layer in self.model if isinstance(layer, _Level)), None)
        down, up = ([], []) if below is None else below.tensors()
        halving, doubling = (
            [layer.weight, layer.bias]
            for kind in (nn.Conv2d, nn.ConvTranspose2d)
            for layer in self.model
            if isinstance(layer, kind)
        )
        return [*halving, *down], [*doubling, *up]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.model(x)
        return torch.cat([x, y], 1) if self.skip else y


def _is_fast(offsets: torch.Tensor, encoding: torch.Tensor) -> bool:
    """Whether the C++ network can take them: float32 on the CPU, and no gradient is asked of the offsets."""
    plain = all(x.device.type == "cpu" and x.dtype == torch.float32 for x in (offsets, encoding))
    return plain and not offsets.requires_grad and not torch.onnx.is_in_onnx_export()


def positional_encoding(size: int) -> torch.Tensor:
    """[24, S, S]: for row, then column: sines, then cosines of 2^0..2^5 times it, in [-1, 1) (fact 21)."""
    coordinate = torch.arange(size, dtype=torch.float64) / size * 2 - 1
    angles = coordinate * 2.0 ** torch.arange(ENCODING_FREQUENCIES, dtype=torch.float64)[:, None]  # [6, S]
    waves = torch.cat([angles.sin(), angles.cos()])  # [12, S]
    rows, columns = waves[:, :, None].expand(-1, -1, size), waves[:, None, :].expand(-1, size, -1)
    return torch.cat([rows, columns]).float()


def downsamplings(size: int) -> int:
    """How often a grid of `size` px is halved: to 2 px, at most 6 times.

    Raises:
        ValueError: The size is not a power of two of at least 8.
    """
    if size < 8 or size & (size - 1):
        raise ValueError(f"grid size: expected a power of two of at least 8, got {size}")
    return min(MAX_DOWNSAMPLINGS, int(math.log2(size)) - 1)


def _down(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 4, stride=2, padding=1)


def _up(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    return nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1)


def _norm(channels: int) -> nn.InstanceNorm2d:
    return nn.InstanceNorm2d(channels, eps=1e-5)
