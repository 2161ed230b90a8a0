"""The deformation U-Net as an ONNX file, from its weights alone; no torch here.

The graph is written node by node (`bundle.unet_graph`): it is short, and holds nothing but what a player
needs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from cap4d.bundle.onnx_half import HALF
from cap4d.bundle.unet_graph import UnetGraph
from cap4d.errors import ArgumentError

OPSET, IR_VERSION = 17, 8


def unet_onnx(weights: Mapping[str, np.ndarray]) -> bytes:
    """The network as a serialised ONNX model (opset 17, plain operators, weights inside).

    Args:
        weights: As of `UnetGraph`.
    Raises:
        ArgumentError: One is missing.
    """
    try:
        return _serialised(UnetGraph(weights))
    except KeyError as error:
        raise ArgumentError(f"deform.onnx: expected the weights of a U-Net, {error} is missing") from None


def network_weights(model: bytes) -> dict[str, np.ndarray]:
    """The weights of an exported network, in float32, as `unet_onnx` takes them."""
    arrays = {t.name: numpy_helper.to_array(t) for t in onnx.load_from_string(model).graph.initializer}
    floats = {name: array for name, array in arrays.items() if array.dtype.kind == "f"}
    return {name.removesuffix(HALF): array.astype(np.float32) for name, array in floats.items()}


def _serialised(unet: UnetGraph) -> bytes:
    shape = [1, 3, unet.size, unet.size]
    graph = helper.make_graph(
        [helper.make_node(n.operator, n.inputs, [n.output], **n.attributes) for n in unet.nodes],
        "deformer",
        [helper.make_tensor_value_info("offsets", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("deformation", TensorProto.FLOAT, shape)],
        [numpy_helper.from_array(np.array(a, order="C"), name) for name, a in unet.constants.items()],
    )
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(graph, producer_name="cap4d", opset_imports=opset, ir_version=IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()
