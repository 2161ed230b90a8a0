"""The exported deformation U-Net as a list of nodes, from its weights alone: what `export.unet_onnx` writes
to a file, and what `float_unet` compares a file with. Neither torch nor the `onnx` package.

Input `offsets` float32[1, 3, S, S] m, output `deformation` float32[1, 3, S, S] m; mask, positional encoding
and scales are inside. Weights keep torch's names and layout, whatever the graph makes of them: what depends
on nothing but constants a runtime computes once, as it loads.

Two things are rewritten, exact but for rounding. The 24 channels of positional encoding never change, so what
the first convolution makes of them is one constant map, added to what it makes of the 3 channels of offsets:
3.0 ms instead of 3.9 at width 16, 20.1 instead of 21.7 at width 64 (two threads of a Zen 4). And the last
layer's weights carry the scale to metres.

A transposed convolution stays one. As four 2x2 convolutions, as one with four times the channels, or as one
3x3, each with DepthToSpace, it is as exact, but onnxruntime takes 3.8, 3.2 and 3.8 ms where it took 2.9
(width 16), and 22.5, 24.4 and 34.2 where it took 20.6 (width 64): copies cost what the convolutions gain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

NORM_EPS = np.float32(1e-5)  # fact 22
SLOPE = np.float32(0.2)
OUTER = "model.model"
Attribute = int | float | list[int]


@dataclass(frozen=True)
class Node:
    """An operator of ONNX with one output.

    Args:
        attributes: By name.
    """

    operator: str
    inputs: tuple[str, ...]
    output: str
    attributes: dict[str, Attribute]


def layer_names(depth: int) -> list[tuple[str, str]]:
    """The names of down i and up i in the released state dicts, without `.weight` and `.bias`."""
    names, prefix = [], "model"
    for i in range(depth):
        first, last = (0, 3) if i == 0 else (1, 3 if i == depth - 1 else 5)
        names.append((f"{prefix}.model.{first}", f"{prefix}.model.{last}"))
        prefix = f"{prefix}.model.{1 if i == 0 else 3}"
    return names


class UnetGraph:
    """Nodes in order, and constants by name.

    Args:
        weights: float32, under the names of the released state dicts (`model.model.0.weight` ...), and
            `scale` [1, 1, S, S], which masks and scales the offsets; `rows` [1, 12, S, 1] and `columns`
            [1, 12, 1, S], the positional encoding; `metres` [], which scales the answer.
    Raises:
        KeyError: One is missing.
    """

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        self.weights = weights
        self.nodes: list[Node] = []
        self.constants: dict[str, np.ndarray] = {}
        self.size = weights["scale"].shape[-1]
        scaled = self._node("Mul", "offsets", self._weight("scale"))
        x = self._below(f"{OUTER}.1", self._first(scaled))
        self._last(self._node("Relu", x))

    def _first(self, scaled: str) -> str:
        """The first convolution: of the offsets, plus a constant map that is its answer to the encoding."""
        weight, bias = self._layer(f"{OUTER}.0")
        inputs, half = self.weights[weight].shape[1], self.weights["rows"].shape[1]
        of_offsets, of_encoding = (self._channels(weight, *ends) for ends in ((0, 3), (3, inputs)))
        plane = self._constant("plane", np.array([1, half, self.size, self.size]))
        halves = [self._node("Expand", self._weight(name), plane) for name in ("rows", "columns")]
        constant = self._halved(self._node("Concat", *halves, axis=1), of_encoding, bias)
        return self._node("Add", self._halved(scaled, of_offsets), constant)

    def _channels(self, weight: str, first: int, end: int) -> str:
        """The part of a convolution's weights that reads channels `first` to `end` of its input."""
        numbers = [self._constant(f"int_{i}", np.array([i])) for i in (first, end, 1)]
        return self._node("Slice", weight, *numbers)

    def _below(self, name: str, x: str) -> str:
        """One resolution of the U-Net (see `avatar.deformer._Level`), which holds the next one inside."""
        y = self._node("LeakyRelu", x, alpha=SLOPE)
        y = self._halved(y, *self._layer(f"{name}.model.1"))
        if f"{name}.model.3.weight" in self.weights:  # innermost: one value per pixel pair, not normalised
            up = f"{name}.model.3"
        else:
            y = self._below(f"{name}.model.3", self._normalised(y, f"{name}.model.1"))
            up = f"{name}.model.5"
        y = self._doubled(self._node("Relu", y), *self._layer(up))
        return self._node("Concat", x, self._normalised(y, up), axis=1)

    def _last(self, x: str) -> None:
        """The last layer, whose weights carry the scale to metres."""
        metres = self._weight("metres")
        scaled = [self._node("Mul", tensor, metres) for tensor in self._layer(f"{OUTER}.3")]
        self._doubled(x, *scaled, output="deformation")

    def _layer(self, name: str) -> tuple[str, str]:
        return self._weight(f"{name}.weight"), self._weight(f"{name}.bias")

    def _halved(self, *inputs: str) -> str:
        return self._node("Conv", *inputs, kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1])

    def _doubled(self, *inputs: str, output: str | None = None) -> str:
        shape = dict(kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1])
        return self._node("ConvTranspose", *inputs, output=output, **shape)

    def _normalised(self, x: str, layer: str) -> str:
        """`x`, the answer of that layer, normalised."""
        channels = len(self.weights[f"{layer}.bias"])
        one = self._constant(f"ones_{channels}", np.ones(channels, np.float32))
        zero = self._constant(f"zeros_{channels}", np.zeros(channels, np.float32))
        return self._node("InstanceNormalization", x, one, zero, epsilon=NORM_EPS)

    def _weight(self, name: str) -> str:
        return self._constant(name, self.weights[name])

    def _constant(self, name: str, value: np.ndarray) -> str:
        self.constants.setdefault(name, value)
        return name

    def _node(self, operator: str, *inputs: str, output: str | None = None, **attributes: Attribute) -> str:
        output = output or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(Node(operator, inputs, output, attributes))
        return output
