"""The deformation network as a self-contained ONNX file, and how far it is from torch.

The graph is written node by node: it is short, and holds nothing but what a player needs. Input `offsets`
float32[1, 3, S, S] m, output `deformation` float32[1, 3, S, S] m; mask, positional encoding and scales are
inside.
"""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from cap4d.avatar.deformer import DEFORM_STD, ENCODING_CHANNELS, Deformer

OPSET, IR_VERSION = 17, 8


def export_deformer(deformer: Deformer) -> bytes:
    """The network as a serialised ONNX model (opset 17, plain operators, weights inside)."""
    graph = _Graph()
    size = deformer.size
    graph.constant("scale", deformer.mask.numpy()[None, None] / np.float32(DEFORM_STD))
    half = ENCODING_CHANNELS // 2
    encoding = deformer.encoding.numpy()[None]
    # Only one row and one column of it is stored: the whole would weigh a third of what the network reads per
    # frame.
    graph.constant("rows", encoding[:, :half, :, :1])
    graph.constant("columns", encoding[:, half:, :1, :])
    graph.constant("plane", np.array([1, half, size, size], np.int64))
    scaled = graph.node("Mul", ["offsets", "scale"])
    rows = graph.node("Expand", ["rows", "plane"])
    columns = graph.node("Expand", ["columns", "plane"])
    x = graph.node("Concat", [scaled, rows, columns], axis=1)
    x = graph.level(deformer.model, x, "model")
    graph.constant("metres", np.array(DEFORM_STD, np.float32))
    graph.node("Mul", [x, "metres"], output="deformation")
    return graph.serialise(size)


def worst_difference(onnx_model: bytes, deformer: Deformer, offsets: torch.Tensor) -> float:
    """Largest difference between onnxruntime and torch on maps [B, 3, S, S] m, relative to the range of
    torch's answers.

    Zero where the network answers nothing but zeros, as it does before its first step.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(onnx_model, options, providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = torch.cat([deformer(o[None]) for o in offsets]).numpy()
    found = np.concatenate([session.run(None, {"offsets": o[None].numpy()})[0] for o in offsets])
    span = float(expected.max() - expected.min())
    error = float(np.abs(found - expected).max())
    return error / span if span > 0 else error


class _Graph:
    """Nodes and initialisers in the making."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: dict[str, onnx.TensorProto] = {}

    def constant(self, name: str, value: np.ndarray) -> str:
        if name not in self.initializers:
            self.initializers[name] = numpy_helper.from_array(np.array(value, order="C"), name)
        return name

    def node(self, kind: str, inputs: list[str], *, output: str | None = None, **attributes) -> str:
        output = output or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def level(self, level: nn.Module, x: str, name: str) -> str:
        """One resolution of the U-Net (see `deformer._Level`), which holds the next one inside."""
        y = x
        for index, layer in enumerate(level.model):
            y = self.layer(layer, y, f"{name}.model.{index}")
        return self.node("Concat", [x, y], axis=1) if level.skip else y

    def layer(self, layer: nn.Module, x: str, name: str) -> str:
        match layer:
            case nn.Conv2d() | nn.ConvTranspose2d():
                kind = "Conv" if isinstance(layer, nn.Conv2d) else "ConvTranspose"
                weight = self.constant(f"{name}.weight", layer.weight.detach().numpy())
                bias = self.constant(f"{name}.bias", layer.bias.detach().numpy())
                shape = dict(kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1])
                return self.node(kind, [x, weight, bias], **shape)
            case nn.InstanceNorm2d():
                channels = layer.num_features
                one = self.constant(f"ones_{channels}", np.ones(channels, np.float32))
                zero = self.constant(f"zeros_{channels}", np.zeros(channels, np.float32))
                return self.node("InstanceNormalization", [x, one, zero], epsilon=layer.eps)
            case nn.LeakyReLU():
                return self.node("LeakyRelu", [x], alpha=layer.negative_slope)
            case nn.ReLU():
                return self.node("Relu", [x])
            case _:
                return self.level(layer, x, name)

    def serialise(self, size: int) -> bytes:
        shape = [1, 3, size, size]
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
