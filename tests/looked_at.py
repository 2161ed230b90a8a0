"""Pairs of pictures whose faces are known, and networks of a user small enough to make here."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.evaluate.pair import Pair


class GivenFaces:
    """Finds the landmarks it was given, one after the other: the picture's, then the truth's."""

    def __init__(self, *points: np.ndarray | None) -> None:
        self._points = list(points)

    def find(self, _: np.ndarray, *, key: object = None) -> np.ndarray | None:
        return self._points.pop(0)


def soft_noise(size: int = 64, *, seed: int = 0) -> np.ndarray:
    """float32[size, size, 3] in [0, 1]: waves of some pixels' length, with edges."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size)) / size
    waves = sum(
        np.sin(2 * np.pi * (a * x + b * y) + c)[..., None] * rng.uniform(0, 1, 3)
        for a, b, c in rng.uniform(-9, 9, (12, 3))
    )
    return (0.5 + 0.4 * np.tanh(waves)).astype(np.float32)


def faced_pair(image: np.ndarray | None, truth: np.ndarray | None, *, size: int = 512) -> Pair:
    """Grey pictures in which these landmarks are found."""
    grey = np.full((size, size, 3), 0.5, np.float32)
    return Pair(grey, grey, finder=GivenFaces(image, truth))


def write_network(
    path: Path, outputs: dict[str, int], *, size: int, seed: int = 0, scale: float = 1.0
) -> Path:
    """ONNX float32[1, 3, size, size] -> vectors by name: linear maps of 4 x 4 blocks."""
    import onnx
    from onnx import numpy_helper
    from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info

    rng = np.random.default_rng(seed)
    side = size // 4
    nodes = [
        make_node("AveragePool", ["input"], ["small"], kernel_shape=[side, side], strides=[side, side]),
        make_node("Flatten", ["small"], ["flat"]),
    ]
    weights = []
    for name, length in outputs.items():
        matrix = (scale * rng.normal(size=(48, length)).clip(-1, 1)).astype(np.float32)
        weights.append(numpy_helper.from_array(matrix, f"{name}_weight"))
        nodes.append(make_node("MatMul", ["flat", f"{name}_weight"], [name]))
    sizes = [1, 3, size, size]
    graph = make_graph(
        nodes,
        "user",
        [make_tensor_value_info("input", onnx.TensorProto.FLOAT, sizes)],
        [make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, n]) for name, n in outputs.items()],
        weights,
    )
    onnx.save(make_model(graph, opset_imports=[make_opsetid("", 18)], ir_version=8), path)
    return path
