"""The deformation network in 8-bit integers, its ranges taken from the avatar's own expressions.

Weights get a scale per output channel, and activations one per channel, which is folded into the weights that
read them. Ranges hold everything that was seen, and half as much again: clipping, also of what was not seen,
costs more than coarser steps do. (Over the held-out frames of two avatars, ranges of least squared error came
to 0.14 mm at most; these to 0.04 mm, at the same RMS.) The first layer stays in float32, its constant inputs
summed up once. What is stored is described in `bundle.quantized_unet`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

from cap4d.bundle.float_unet import first_layer
from cap4d.bundle.quantized_unet import SMALLEST_SCALE, check_quantized, depth
from cap4d.bundle.unet_graph import layer_names
from cap4d.export.unet_onnx import network_weights
from cap4d.track.progress import progress

LEAK = 0.2
NORM_EPS = 1e-5
MARGIN = np.float32(1.5)  # of activations' ranges over what was seen
WEIGHT_MAX = 127
STEPS, SMALLEST_STEP = 255, np.float32(1e-6)
Range = tuple[np.ndarray, np.ndarray]  # least and largest value, [C] each


def quantize(onnx_model: bytes, offsets: np.ndarray) -> dict[str, np.ndarray]:
    """A network for `_core.QuantizedUnet`.

    Args:
        onnx_model: What `export_deformer` wrote.
        offsets: float32[B, 3, S, S] m, what the network will be asked; some tens of expressions.
    Returns:
        The tensors of `bundle.quantized_unet`.
    """
    net = _FloatNet.load(onnx_model)
    ranges = net.ranges(torch.from_numpy(np.ascontiguousarray(offsets, np.float32)))
    tensors = {"mask": net.mask.astype(np.uint8), **net.first_layer}
    inputs: dict[str, np.ndarray] = {}
    for i in range(net.depth):
        if i > 0:
            weight = net.down[i][0] * inputs[f"leaky{i - 1}"][:, None, None]
            tensors[f"down{i}.weight"], tensors[f"down{i}.scale"] = _quantize_weight(weight)
        if i == net.depth - 1:
            tensors[f"down{i}.bias"] = net.down[i][1]
        else:
            scale, zero = _leaky_steps(ranges[f"down{i}"])
            tensors[f"down{i}.leaky_scale"], tensors[f"down{i}.leaky_zero"] = scale, zero
            inputs[f"leaky{i}"] = scale
        tensors[f"down{i}.relu_scale"] = inputs[f"relu{i}"] = _relu_steps(ranges[f"down{i}"])
    below: list[np.ndarray] = []  # the scales of what up i + 1 puts out
    for i in reversed(range(net.depth)):
        scales = np.concatenate([inputs[f"relu{i}"], *below])
        weight = np.moveaxis(net.up[i][0] * scales[:, None, None, None], 1, 0)
        quantized, scale = _quantize_weight(weight)
        tensors[f"up{i}.weight"] = np.ascontiguousarray(np.moveaxis(quantized, 0, 1))
        tensors[f"up{i}.scale"] = scale * (net.metres if i == 0 else np.float32(1))
        if i > 0:
            tensors[f"up{i}.relu_scale"] = _relu_steps(ranges[f"up{i}"])
            below = [tensors[f"up{i}.relu_scale"]]
    tensors["up0.bias"] = net.up[0][1] * net.metres
    check_quantized(tensors, source="quantize", size=net.size)
    return tensors


@dataclass(frozen=True)
class _FloatNet:
    """The exported network's numbers: per layer weight and bias, as torch has them."""

    size: int
    mask: np.ndarray
    per_metre: np.float32
    metres: np.float32
    encoding: torch.Tensor
    first_layer: dict[str, np.ndarray]
    down: list[tuple[np.ndarray, np.ndarray]]
    up: list[tuple[np.ndarray, np.ndarray]]

    @classmethod
    def load(cls, onnx_model: bytes) -> _FloatNet:
        values = network_weights(onnx_model)
        scale = values["scale"][0, 0]
        size = len(scale)
        rows, columns = (torch.from_numpy(values[name].copy()) for name in ("rows", "columns"))
        plane = (-1, -1, size, size)
        down, up = (
            [(values[f"{name}.weight"], values[f"{name}.bias"]) for name in names]
            for names in zip(*layer_names(depth(size)), strict=True)
        )
        encoding = torch.cat([rows.expand(plane), columns.expand(plane)], 1)
        tables = first_layer(values)
        return cls(size, scale > 0, scale.max(), values["metres"], encoding, tables, down, up)

    @property
    def depth(self) -> int:
        return len(self.down)

    def ranges(self, offsets: torch.Tensor) -> dict[str, Range]:
        """Of what each layer hands to its activation, over offsets [B, 3, S, S]."""
        seen: dict[str, list[torch.Tensor]] = {}
        for one in progress(offsets, "int8 deformer", len(offsets)):
            for name, value in self.forward(one).items():
                seen.setdefault(name, []).append(torch.stack(value[0].flatten(1).aminmax(dim=1)))
        stacked = {name: torch.stack(values) for name, values in seen.items()}  # [B, 2, C]
        return {name: (x[:, 0].amin(0).numpy(), x[:, 1].amax(0).numpy()) for name, x in stacked.items()}

    def forward(self, offsets: torch.Tensor) -> dict[str, torch.Tensor]:
        """Offsets [3, S, S] -> by layer what it hands to its activation, [1, C, H, W]."""
        values: dict[str, torch.Tensor] = {}
        scaled = offsets[None] * torch.from_numpy(self.mask.astype(np.float32) * self.per_metre)
        x = torch.cat([scaled, self.encoding], 1)
        for i, (weight, bias) in enumerate(self.down):
            x = functional.conv2d(x, torch.from_numpy(weight), torch.from_numpy(bias), stride=2, padding=1)
            if 0 < i < self.depth - 1:
                x = functional.instance_norm(x, eps=NORM_EPS)
            values[f"down{i}"] = x
            x = functional.leaky_relu(x, LEAK)
        x = values[f"down{self.depth - 1}"]
        for i in reversed(range(1, self.depth)):
            weight, bias = (torch.from_numpy(v) for v in self.up[i])
            x = functional.conv_transpose2d(x.relu(), weight, bias, stride=2, padding=1)
            values[f"up{i}"] = functional.instance_norm(x, eps=NORM_EPS)
            x = torch.cat([values[f"down{i - 1}"], values[f"up{i}"]], 1)
        return values


def _quantize_weight(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """float32[C, ...] -> int8[C, ...] and the scale per C."""
    flat = weight.reshape(len(weight), -1)
    scale = np.maximum(np.abs(flat).max(1) / WEIGHT_MAX, SMALLEST_SCALE).astype(np.float32)
    quantized = (flat / scale[:, None]).round().clip(-WEIGHT_MAX, WEIGHT_MAX).astype(np.int8)
    return quantized.reshape(weight.shape), scale


def _leaky_steps(seen: Range) -> Range:
    """Scale and zero per channel of LeakyReLU's output, of what it was handed."""
    low, high = np.minimum(seen[0], 0) * np.float32(LEAK), np.maximum(seen[1], 0)
    scale = np.maximum(MARGIN * (high - low) / STEPS, SMALLEST_STEP)
    return scale, (-MARGIN * low / scale).round().astype(np.uint8)


def _relu_steps(seen: Range) -> np.ndarray:
    """Scale per channel of ReLU's output, of what it was handed."""
    return np.maximum(MARGIN * seen[1] / STEPS, SMALLEST_STEP)
