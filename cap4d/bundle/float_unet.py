"""The tensors of a deformation network in float32, as `_core.FloatUnet` takes them, out of its ONNX file.

The network and its numbers are those of `quantized_unet`, but that nothing is quantised:

    mask             uint8[S, S]            1 where offsets are read
    down0.weight     float32[C_0, 3, 4, 4]  1/m
    down0.rows, down0.columns  float32[3, S/2, C_0]  what the positional encoding and the bias add
    down{i}.weight   float32[C_i, C_(i-1), 4, 4]
    down{i}.bias     float32[C_i]           of the innermost layer; the others are normalised, which undoes it
    up{i}.weight     float32[inputs, C_(i-1), 4, 4]
    up0.scale, up0.bias  float32[3]         m

Our own arithmetic knows this one network only. A file is taken for it when its graph is, node by node, what
`UnetGraph` makes of the weights in it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cap4d.bundle.onnx_half import HALF
from cap4d.bundle.onnx_scan import FLOAT, read_graph
from cap4d.bundle.quantized_unet import MAX_SIZE, MAX_WIDTH, MIN_SIZE, channels, depth
from cap4d.bundle.unet_graph import Node, UnetGraph, layer_names

ENCODING = 12  # channels of the rows' positional encoding, and of the columns'
AXES = 3


def float_unet(model: bytes, size: int) -> dict[str, np.ndarray] | None:
    """The tensors of a network for a grid of `size` px.

    Args:
        model: The ONNX file, already scanned (`onnx_scan`).
        size: S.
    Returns:
        None where it is another network than the exported U-Net, of this or another version.
    """
    graph = read_graph(model)
    if graph is None or not MIN_SIZE <= size <= MAX_SIZE or size & (size - 1):
        return None
    nodes, tensors = _as_float32(*graph)
    weights = _weights_of(tensors, size)
    if weights is None or not _is_exported(nodes, tensors, weights):
        return None
    return _tensors(weights, size)


def first_layer(weights: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The first layer with its constant inputs summed up, in float64. They depend on the row, or on the
    column, but at the border, where a column, or a row, of the kernel hangs over.
    """
    name = layer_names(1)[0][0]
    weight = weights[f"{name}.weight"].astype(np.float64)
    encoding = np.concatenate([weights["rows"][0, :, :, 0], weights["columns"][0, :, 0]]).astype(np.float64)
    of_rows, of_columns = weight[:, AXES : AXES + ENCODING], weight[:, AXES + ENCODING :].swapaxes(2, 3)
    tables = {
        "down0.weight": weight[:, :AXES] * float(weights["scale"].max()),
        "down0.rows": _along(encoding[:ENCODING], of_rows) + weights[f"{name}.bias"],
        "down0.columns": _along(encoding[ENCODING:], of_columns),
    }
    return {name: np.ascontiguousarray(value, np.float32) for name, value in tables.items()}


def _along(encoding: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Encoding [12, S] and weight [C, 12, 4 along it, 4 across] -> [3, S/2, C]: at the first, an inner and
    the last place across.
    """
    across = np.stack([weight[..., 1:].sum(3), weight.sum(3), weight[..., :-1].sum(3)])  # [3, C, 12, 4]
    padded = np.pad(encoding, ((0, 0), (1, 1)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=1)[:, ::2]  # [12, S/2, 4]
    return np.einsum("ecak,ahk->ehc", across, windows)


def _as_float32(
    nodes: list[Node], tensors: dict[str, np.ndarray]
) -> tuple[list[Node], dict[str, np.ndarray]]:
    """Without the Casts that make float32 of weights stored as float16 (`onnx_half`)."""
    found, left = dict(tensors), list(nodes)
    for node in nodes:
        stored = f"{node.output}{HALF}"
        if node == Node("Cast", (stored,), node.output, {"to": FLOAT}) and stored in found:
            found[node.output] = found.pop(stored).astype(np.float32)
            left.remove(node)
    return left, found


def _weights_of(tensors: dict[str, np.ndarray], size: int) -> dict[str, np.ndarray] | None:
    """Those of the U-Net, if they are all there and of the right shapes, and the mask is one."""
    first = tensors.get(f"{layer_names(1)[0][0]}.weight")
    width = first.shape[0] if first is not None and first.ndim == 4 else 0
    if not 1 <= width <= MAX_WIDTH:
        return None
    shapes = _shapes(size, width)
    for name, shape in shapes.items():
        found = tensors.get(name)
        if found is None or found.dtype != np.float32 or found.shape != shape:
            return None
    scale = tensors["scale"]
    per_metre = scale.max()
    return {name: tensors[name] for name in shapes} if ((scale == 0) | (scale == per_metre)).all() else None


def _shapes(size: int, width: int) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {
        "scale": (1, 1, size, size),
        "rows": (1, ENCODING, size, 1),
        "columns": (1, ENCODING, 1, size),
        "metres": (),
    }
    count = depth(size)
    for i, (down, up) in enumerate(layer_names(count)):
        own, outer = channels(width, i), channels(width, i - 1) if i else AXES
        inputs = outer if i else AXES + 2 * ENCODING
        shapes[f"{down}.weight"], shapes[f"{down}.bias"] = (own, inputs, 4, 4), (own,)
        below = own if i == count - 1 else 2 * own
        shapes[f"{up}.weight"], shapes[f"{up}.bias"] = (below, outer, 4, 4), (outer,)
    return shapes


def _is_exported(nodes: list[Node], tensors: dict[str, np.ndarray], weights: dict[str, np.ndarray]) -> bool:
    graph = UnetGraph(weights)
    if graph.nodes != nodes or graph.constants.keys() != tensors.keys():
        return False
    pairs = ((value, tensors[name]) for name, value in graph.constants.items())
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in pairs)


def _tensors(weights: dict[str, np.ndarray], size: int) -> dict[str, np.ndarray]:
    metres, names = weights["metres"], layer_names(depth(size))
    tensors = {"mask": (weights["scale"][0, 0] > 0).astype(np.uint8), **first_layer(weights)}
    for i, (down, up) in enumerate(names):
        if i:
            tensors[f"down{i}.weight"] = weights[f"{down}.weight"]
        tensors[f"up{i}.weight"] = weights[f"{up}.weight"]
    tensors[f"down{len(names) - 1}.bias"] = weights[f"{names[-1][0]}.bias"]
    tensors["up0.scale"] = np.full(AXES, metres, np.float32)
    tensors["up0.bias"] = weights[f"{names[0][1]}.bias"] * metres
    return {name: np.require(value, requirements=["C", "A"]) for name, value in tensors.items()}
