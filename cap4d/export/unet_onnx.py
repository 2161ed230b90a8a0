"""The deformation U-Net as an ONNX graph, from its weights alone; no torch here.

The graph is written node by node: it is short, and holds nothing but what a player needs. Input `offsets`
float32[1, 3, S, S] m, output `deformation` float32[1, 3, S, S] m; mask, positional encoding and scales are
inside. Weights keep torch's names and layout in the file, whatever the graph makes of them: what depends on
nothing but constants a runtime computes once, as it loads.

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

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from cap4d.errors import ArgumentError

OPSET, IR_VERSION = 17, 8
NORM_EPS = 1e-5  # fact 22
SLOPE = 0.2
OUTER = "model.model"
HALF = ".float16"  # how `bundle.onnx_half` names what it rounds


def unet_onnx(weights: Mapping[str, np.ndarray]) -> bytes:
    """The network as a serialised ONNX model (opset 17, plain operators, weights inside).

    Args:
        weights: float32, under the names of the released state dicts (`model.model.0.weight` ...), and
            `scale` [1, 1, S, S], which masks and scales the offsets; `rows` [1, 12, S, 1] and `columns`
            [1, 12, 1, S], the positional encoding; `metres` [], which scales the answer.
    Raises:
        ArgumentError: One is missing.
    """
    try:
        return _Graph(weights).serialise()
    except KeyError as error:
        raise ArgumentError(f"deform.onnx: expected the weights of a U-Net, {error} is missing") from None


def network_weights(model: bytes) -> dict[str, np.ndarray]:
    """The weights of an exported network, in float32, as `unet_onnx` takes them."""
    arrays = {t.name: numpy_helper.to_array(t) for t in onnx.load_from_string(model).graph.initializer}
    floats = {name: array for name, array in arrays.items() if array.dtype.kind == "f"}
    return {name.removesuffix(HALF): array.astype(np.float32) for name, array in floats.items()}


def rewritten(model: bytes) -> bytes:
    """An exported network, of whatever age, as this version writes it: float32 weights, the same function.

    Raises:
        ArgumentError: It is not an exported U-Net.
    """
    return unet_onnx(network_weights(model))


class _Graph:
    """Nodes and initialisers in the making."""

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        self.weights = weights
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: dict[str, onnx.TensorProto] = {}
        self.size = weights["scale"].shape[-1]
        scaled = self.node("Mul", "offsets", self.weight("scale"))
        x = self.below(f"{OUTER}.1", self.first(scaled))
        self.last(self.node("Relu", x))

    def first(self, scaled: str) -> str:
        """The first convolution: of the offsets, plus a constant map that is its answer to the encoding."""
        weight, bias = self.layer(f"{OUTER}.0")
        inputs, half = self.weights[weight].shape[1], self.weights["rows"].shape[1]
        of_offsets, of_encoding = (self.channels(weight, *ends) for ends in ((0, 3), (3, inputs)))
        plane = self.constant("plane", np.array([1, half, self.size, self.size]))
        halves = [self.node("Expand", self.weight(name), plane) for name in ("rows", "columns")]
        constant = self.halved(self.node("Concat", *halves, axis=1), of_encoding, bias)
        return self.node("Add", self.halved(scaled, of_offsets), constant)

    def channels(self, weight: str, first: int, end: int) -> str:
        """The part of a convolution's weights that reads channels `first` to `end` of its input."""
        numbers = [self.constant(f"int_{i}", np.array([i])) for i in (first, end, 1)]
        return self.node("Slice", weight, *numbers)

    def below(self, name: str, x: str) -> str:
        """One resolution of the U-Net (see `avatar.deformer._Level`), which holds the next one inside."""
        y = self.node("LeakyRelu", x, alpha=SLOPE)
        y = self.halved(y, *self.layer(f"{name}.model.1"))
        if f"{name}.model.3.weight" in self.weights:  # innermost: one value per pixel pair, not normalised
            up = f"{name}.model.3"
        else:
            y = self.below(f"{name}.model.3", self.normalised(y, f"{name}.model.1"))
            up = f"{name}.model.5"
        y = self.doubled(self.node("Relu", y), *self.layer(up))
        return self.node("Concat", x, self.normalised(y, up), axis=1)

    def last(self, x: str) -> None:
        """The last layer, whose weights carry the scale to metres."""
        metres = self.weight("metres")
        scaled = [self.node("Mul", tensor, metres) for tensor in self.layer(f"{OUTER}.3")]
        self.doubled(x, *scaled, output="deformation")

    def layer(self, name: str) -> tuple[str, str]:
        return self.weight(f"{name}.weight"), self.weight(f"{name}.bias")

    def halved(self, *inputs: str) -> str:
        return self.node("Conv", *inputs, kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1])

    def doubled(self, *inputs: str, output: str | None = None) -> str:
        shape = dict(kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1])
        return self.node("ConvTranspose", *inputs, output=output, **shape)

    def normalised(self, x: str, layer: str) -> str:
        """`x`, the answer of that layer, normalised."""
        channels = len(self.weights[f"{layer}.bias"])
        one = self.constant(f"ones_{channels}", np.ones(channels, np.float32))
        zero = self.constant(f"zeros_{channels}", np.zeros(channels, np.float32))
        return self.node("InstanceNormalization", x, one, zero, epsilon=NORM_EPS)

    def weight(self, name: str) -> str:
        return self.constant(name, self.weights[name])

    def constant(self, name: str, value: np.ndarray) -> str:
        if name not in self.initializers:
            self.initializers[name] = numpy_helper.from_array(np.array(value, order="C"), name)
        return name

    def node(self, kind: str, *inputs: str, output: str | None = None, **attributes) -> str:
        output = output or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def serialise(self) -> bytes:
        shape = [1, 3, self.size, self.size]
        graph = helper.make_graph(
            self.nodes,
            "deformer",
            [helper.make_tensor_value_info("offsets", TensorProto.FLOAT, shape)],
            [helper.make_tensor_value_info("deformation", TensorProto.FLOAT, shape)],
            list(self.initializers.values()),
        )
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, producer_name="cap4d", opset_imports=opset, ir_version=IR_VERSION)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString()
