"""Reads just enough of an ONNX file, with bounds checks, to refuse one that is more than a plain network.

An ONNX file can name other files to read (external data), operators of other libraries, and whole programs
(subgraphs, functions). A deformer needs none of these. This is a scanner of protobuf's wire format
(protobuf.dev/programming-guides/encoding); field numbers are those of onnx.proto, IR version 3 to 13.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from cap4d.bundle.unet_graph import Attribute, Node
from cap4d.errors import DataError

MAX_BYTES = 512 << 20
MAX_NODES, MAX_TENSORS, MAX_DIMS, MAX_FIELDS = 2048, 2048, 8, 1 << 16
MIN_OPSET, MAX_OPSET = 13, 26
FLOAT, INT64, FLOAT16 = 1, 7, 10
ITEM_BYTES = {FLOAT: 4, 2: 1, 3: 1, 6: 4, INT64: 8, 9: 1, FLOAT16: 2}  # + uint8, int8, int32, bool

# What a network on images is made of. No control flow, no random numbers, no files, strings or sequences, and
# nothing whose output size is a number in the file (Tile, Range, ConstantOfShape, Resize).
_OPERATOR_NAMES = """
    Abs Add AveragePool BatchNormalization Cast CastLike Clip Concat Constant Conv ConvInteger ConvTranspose
    Cos DequantizeLinear Div DynamicQuantizeLinear Elu Erf Exp Expand Flatten Floor Gather Gelu Gemm
    GlobalAveragePool GroupNormalization HardSigmoid Identity InstanceNormalization LayerNormalization
    LeakyRelu Log MatMul MatMulInteger Max MaxPool Mean Min Mul Neg Pad Pow PRelu QLinearConv QLinearMatMul
    QuantizeLinear
    Reciprocal ReduceMax ReduceMean ReduceMin ReduceSum ReduceSumSquare Relu Reshape Shape Sigmoid Sin Slice
    Softplus Split Sqrt Squeeze Sub Sum Tanh Transpose Unsqueeze Where
"""
OPERATORS = frozenset(_OPERATOR_NAMES.split())

VARINT, BYTES, FIXED32 = 0, 2, 5  # 1 is 8 bytes; nothing here is of it


class _Malformed(Exception):
    """What is wrong, as (field, expected, found)."""


@dataclass(frozen=True)
class OnnxSummary:
    """What a scanned network holds: its opset, its number of nodes and of bytes of weights."""

    opset: int
    nodes: int
    weight_bytes: int


def scan_onnx(data: bytes, *, source: str, size: int) -> OnnxSummary:
    """Checks that `data` is a self-contained network, float32[1, 3, size, size] in and out.

    Raises:
        DataError: It is not, or uses anything beyond plain operators.
    """
    try:
        return _scan_model(memoryview(data), size)
    except _Malformed as error:
        field, expected, found = error.args
        raise DataError(source, field, expected=expected, found=found) from None


def stores_half(data: bytes) -> bool:
    """Whether a scanned network keeps any of its weights as float16 (see `onnx_half`)."""
    model = _message(memoryview(data), "ModelProto", {1, 2, 3, 4, 5, 6, 7, 8, 14})
    graph = _message(model[7][0], "GraphProto", {1, 2, 5, 10, 11, 12, 13, 16})
    tensors = (_message(t, "TensorProto", {1, 2, 8, 9, 12, 14, 16}) for t in graph[5])
    return any(tensor[2][-1:] == [FLOAT16] for tensor in tensors)


def read_graph(data: bytes) -> tuple[list[Node], dict[str, np.ndarray]] | None:
    """The nodes of a scanned network in order, and its initialisers by name, as they are stored.

    None where it has what these cannot say: several outputs of a node, attributes other than numbers, tensors
    other than float32, float16 and int64, or one name twice. The arrays lie in `data`, aligned or not.
    """
    try:
        model = _message(memoryview(data), "ModelProto", {1, 2, 3, 4, 5, 6, 7, 8, 14})
        graph = _message(model[7][0], "GraphProto", {1, 2, 5, 10, 11, 12, 13, 16})
        nodes = [_node(node) for node in graph[1]]
        tensors = [_tensor(tensor) for tensor in graph[5]]
    except (_Malformed, IndexError, KeyError, ValueError):
        return None
    return (nodes, dict(tensors)) if len(dict(tensors)) == len(tensors) else None


def _node(data: memoryview) -> Node:
    node = _message(data, "NodeProto", {1, 2, 3, 4, 5, 7})
    (output,), (operator,) = node[2], node[4]
    attributes = dict(_attribute(attribute) for attribute in node[5])
    return Node(_text(operator), tuple(_text(name) for name in node[1]), _text(output), attributes)


def _attribute(data: memoryview) -> tuple[str, Attribute]:
    attribute = _message(data, "AttributeProto", {1, 2, 3, 8, 20}, fixed32={2})
    (name,), (kind,) = attribute[1], attribute[20]
    numbers = {1: attribute[2], 2: attribute[3], 7: attribute[8]}[kind]
    if kind == 7:
        return _text(name), _integers(numbers, "attribute.ints")
    (number,) = numbers
    return _text(name), np.frombuffer(number, "<f4")[0] if kind == 1 else number


def _tensor(data: memoryview) -> tuple[str, np.ndarray]:
    tensor = _message(data, "TensorProto", {1, 2, 8, 9, 12, 14, 16})
    dtype = {FLOAT: "<f4", FLOAT16: "<f2", INT64: "<i8"}[tensor[2][-1]]
    (name,), (raw,) = tensor[8], tensor[9]
    return _text(name), np.frombuffer(raw, dtype).reshape(_integers(tensor[1], "tensor.dims"))


def _scan_model(data: memoryview, size: int) -> OnnxSummary:
    _require(len(data) <= MAX_BYTES, "size", f"at most {MAX_BYTES} bytes", len(data))
    model = _message(data, "ModelProto", {1, 2, 3, 4, 5, 6, 7, 8, 14})
    _require(len(model[7]) == 1, "graph", "one graph", len(model[7]))
    opsets = [_message(_bytes(o, "opset_import"), "opset_import", {1, 2}) for o in model[8]]
    domains = {_text(o[1][-1]) if o[1] else "" for o in opsets}
    _require(domains <= {"", "ai.onnx"}, "opset_import.domain", "ai.onnx", sorted(domains))
    versions = [o[2][-1] for o in opsets if o[2]]
    good = len(versions) == 1 and isinstance(versions[0], int) and MIN_OPSET <= versions[0] <= MAX_OPSET
    _require(good, "opset_import.version", f"one of {MIN_OPSET} to {MAX_OPSET}", versions)
    nodes, weights = _scan_graph(_bytes(model[7][0], "graph"), size)
    return OnnxSummary(versions[0], nodes, weights)


def _scan_graph(data: memoryview, size: int) -> tuple[int, int]:
    graph = _message(data, "GraphProto", {1, 2, 5, 10, 11, 12, 13, 16})
    _require(len(graph[1]) <= MAX_NODES, "graph.node", f"at most {MAX_NODES}", len(graph[1]))
    _require(len(graph[5]) <= MAX_TENSORS, "graph.initializer", f"at most {MAX_TENSORS}", len(graph[5]))
    _scan_value(graph[11], "input", "offsets", size)
    _scan_value(graph[12], "output", "deformation", size)
    weights = sum(_scan_tensor(_bytes(t, "initializer")) for t in graph[5])
    weights += sum(_scan_node(_bytes(n, "node")) for n in graph[1])
    return len(graph[1]), weights


def _scan_value(values: list, field: str, name: str, size: int) -> None:
    _require(len(values) == 1, f"graph.{field}", f"only `{name}`", f"{len(values)} of them")
    value = _message(_bytes(values[0], field), f"graph.{field}", {1, 2, 3, 4})
    found = _text(value[1][-1]) if value[1] else ""
    _require(found == name, f"graph.{field}", f"`{name}`", repr(found[:64]))
    _require(len(value[2]) == 1, f"graph.{field}.type", "one type", len(value[2]))
    kind = _message(_bytes(value[2][0], field), f"graph.{field}.type", {1, 6})
    _require(len(kind[1]) == 1, f"graph.{field}.type", "a tensor", "something else")
    tensor = _message(_bytes(kind[1][0], field), f"graph.{field}.type", {1, 2})
    _require(tensor[1] == [FLOAT], f"graph.{field}.elem_type", f"{FLOAT} (float32)", tensor[1])
    _require(len(tensor[2]) == 1, f"graph.{field}.shape", "one shape", len(tensor[2]))
    shape = _message(_bytes(tensor[2][0], field), f"graph.{field}.shape", {1})
    dims = [_message(_bytes(d, field), f"graph.{field}.shape", {1, 2, 3})[1] for d in shape[1]]
    sizes = [d[0] if len(d) == 1 else None for d in dims]
    _require(sizes == [1, 3, size, size], f"graph.{field}.shape", f"[1, 3, {size}, {size}]", sizes)


def _scan_node(data: memoryview) -> int:
    node = _message(data, "NodeProto", {1, 2, 3, 4, 5, 6, 7, 9})
    domain = _text(node[7][-1]) if node[7] else ""
    _require(domain in ("", "ai.onnx"), "node.domain", "ai.onnx", repr(domain[:64]))
    operator = _text(node[4][-1]) if node[4] else ""
    _require(operator in OPERATORS, "node.op_type", "a plain operator (see FORMAT.md)", repr(operator[:64]))
    return sum(_scan_attribute(_bytes(a, "attribute")) for a in node[5])


def _scan_attribute(data: memoryview) -> int:
    # Left out: 6 and 11, graphs; 14 and 15, types; 21, a function's argument; 22 and 23, sparse tensors.
    attribute = _message(data, "AttributeProto", {1, 2, 3, 4, 5, 7, 8, 9, 10, 13, 20}, fixed32={2, 7})
    _require(len(attribute[5]) <= 1, "attribute.t", "one tensor", "several, which a parser would merge")
    for value in attribute[2] + attribute[7]:
        _scan_floats(_bytes(value, "attribute.floats"), FLOAT, "attribute.floats")
    return sum(_scan_tensor(_bytes(t, "attribute.t")) for t in attribute[5] + attribute[10])


def _scan_tensor(data: memoryview) -> int:
    # Left out: 3, a segment; 4 to 7, 10 and 11, typed lists of values and strings; 13, external data. 14 is
    # the place of the data and must say "here".
    tensor = _message(data, "TensorProto", {1, 2, 8, 9, 12, 14, 16})
    _require(tensor[14] in ([], [0]), "tensor.data_location", "0 (inside the file)", tensor[14])
    kind = tensor[2][-1] if tensor[2] else None
    _require(kind in ITEM_BYTES, "tensor.data_type", f"one of {sorted(ITEM_BYTES)}", kind)
    dims = _integers(tensor[1], "tensor.dims")
    good = len(dims) <= MAX_DIMS and all(0 <= d < 1 << 31 for d in dims)
    _require(good, "tensor.dims", f"at most {MAX_DIMS} sizes", dims[: MAX_DIMS + 1])
    _require(len(tensor[9]) <= 1, "tensor.raw_data", "one of it", len(tensor[9]))
    raw = _bytes(tensor[9][0], "tensor.raw_data") if tensor[9] else memoryview(b"")
    wanted = math.prod(dims) * ITEM_BYTES[kind]
    _require(len(raw) == wanted, "tensor.raw_data", f"{wanted} bytes", len(raw))
    if kind in (FLOAT, FLOAT16):
        _scan_floats(raw, kind, "tensor.raw_data")
    return len(raw)


def _scan_floats(raw: memoryview, kind: int, field: str) -> None:
    item = ITEM_BYTES[kind]
    _require(len(raw) % item == 0, field, f"numbers of {item} bytes", f"{len(raw)} bytes")
    values = np.frombuffer(raw, f"<f{item}")
    _require(bool(np.isfinite(values).all()), field, "finite numbers", "a value that is not finite")


def _message(
    data: memoryview, name: str, known: set[int], *, fixed32: Collection[int] = ()
) -> defaultdict[int, list]:
    """The fields of one message: number -> values in order, each an int or a memoryview.

    Only fields in `fixed32` may come in 4 bytes and none in 8: a parser passes over a field of another wire
    type than its own, so what was checked here would not be what it sees.
    """
    fields: defaultdict[int, list] = defaultdict(list)
    at = count = 0
    while at < len(data):
        key, at = _varint(data, at)
        count += 1
        _require(count <= MAX_FIELDS, name, f"at most {MAX_FIELDS} fields", "more")
        number, wire = key >> 3, key & 7
        _require(number in known, name, f"only fields {sorted(known)}", f"field {number}")
        if wire == VARINT:
            value, at = _varint(data, at)
        elif wire == BYTES:
            length, at = _varint(data, at)
            value, at = data[at : at + length], at + length
        elif wire == FIXED32 and number in fixed32:
            value, at = data[at : at + 4], at + 4
        else:
            raise _Malformed(name, f"another wire type for field {number}", wire)
        _require(at <= len(data), name, "a whole message", "one cut short")
        fields[number].append(value)
    return fields


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for i in range(10):
        _require(at + i < len(data), "protobuf", "a whole number", "one cut short")
        byte = data[at + i]
        value |= (byte & 0x7F) << (7 * i)
        if byte < 0x80:
            return value, at + i + 1
    raise _Malformed("protobuf", "a number of at most 10 bytes", "more")


def _integers(values: list, field: str) -> list[int]:
    """A repeated integer field, packed or not."""
    numbers: list[int] = []
    for value in values:
        if isinstance(value, int):
            numbers.append(value)
            continue
        at = 0
        while at < len(value):
            number, at = _varint(value, at)
            numbers.append(number)
            _require(len(numbers) <= MAX_DIMS, field, f"at most {MAX_DIMS} numbers", "more")
    return numbers


def _bytes(value: int | memoryview, field: str) -> memoryview:
    if isinstance(value, int):
        raise _Malformed(field, "a message", "a number")
    return value


def _text(value: int | memoryview) -> str:
    return bytes(_bytes(value, "string")).decode("utf-8", "backslashreplace")


def _require(holds: bool, field: str, expected: str, found: object) -> None:
    if not holds:
        raise _Malformed(field, expected, found)
