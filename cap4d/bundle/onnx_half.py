"""Stores an ONNX network's weights as float16, each followed by a Cast back to float32.

Half the bytes in the file; the arithmetic stays float32 (a runtime folds the casts away as it loads).
Only writing needs this, and only this needs the `onnx` package.
"""

from __future__ import annotations

from cap4d.errors import ArgumentError

HALF = ".float16"  # the name of a rounded tensor: the original's with this behind it
MIN_VALUES = 256  # smaller tensors (biases of a few channels, shapes, scalars) are not worth a node


def halve_weights(model: bytes) -> bytes:
    """The same network with its large float32 initialisers rounded to float16.

    Raises:
        ArgumentError: The `onnx` package is not installed, or a weight is beyond float16's range.
    """
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError as error:
        raise ArgumentError(
            "precision float16: expected the `onnx` package, which is not installed"
        ) from error
    import numpy as np

    proto = onnx.load_from_string(model)
    casts = []
    for tensor in proto.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < MIN_VALUES:
            continue
        if np.abs(values).max() > np.finfo(np.float16).max:
            raise ArgumentError(
                f"{tensor.name}: expected weights within float16's range, got {np.abs(values).max():g}"
            )
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}{HALF}"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}{HALF}"], [name], to=onnx.TensorProto.FLOAT))
    nodes = list(proto.graph.node)
    del proto.graph.node[:]
    proto.graph.node.extend(casts + nodes)
    return proto.SerializeToString(deterministic=True)
