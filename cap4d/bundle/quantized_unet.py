"""The tensors of a deformation network in 8-bit integers: names, dtypes, shapes, limits.

The network is that of `avatar.deformer` (facts 20-24) on a grid of S x S px with `width` channels in its
first layer. Down i (0: outermost) halves the map, up i doubles it back; there are `depth(S)` of each, and
down i puts out C_i = width x min(2^i, 8) channels. An activation is `scale x (q - zero)` with q uint8, per
channel; the scales of inputs are folded into the weights, so that a layer's sum of products times its own
`scale` is its float32 value:

    mask             uint8[S, S]            1 where offsets are read
    down0.weight     float32[C_0, 3, 4, 4]  1/m; the layer is not quantised
    down0.rows       float32[3, S/2, C_0]   what the rows' positional encoding and the bias add, at the first,
                                            an inner and the last column
    down0.columns    float32[3, S/2, C_0]   the same of the columns' encoding, at the first, an inner, the
                                            last row
    down{i}.weight   int8[C_i, C_(i-1), 4, 4]
    down{i}.scale    float32[C_i]
    down{i}.bias     float32[C_i]           of the innermost layer; the others are normalised, which undoes it
    down{i}.leaky_scale, leaky_zero  float32[C_i], uint8[C_i]  of LeakyReLU's output; not of the innermost
    down{i}.relu_scale               float32[C_i]              of ReLU's output, whose zero is 0
    up{i}.weight     int8[inputs, C_(i-1), 4, 4]  inputs are C_i of down i, then C_i of up i + 1; up 0 has 3
                                            outputs
    up{i}.scale      float32[C_(i-1)]       of up 0: m
    up{i}.relu_scale float32[C_(i-1)]       not of up 0
    up0.bias         float32[3]             m
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cap4d.errors import DataError

MIN_SIZE, MAX_SIZE = 8, 512  # px
MAX_WIDTH = 256  # sums of products then stay below 2^31
MAX_DEPTH = 6
SMALLEST_SCALE, LARGEST = 1e-12, 1e6  # of scales; of everything else in float


@dataclass(frozen=True)
class QuantizedSpec:
    """What one tensor must be.

    Args:
        shape: Its sizes.
        dtype: Its type.
        low: The least value allowed. The largest is LARGEST.
    """

    shape: tuple[int, ...]
    dtype: type
    low: float = -LARGEST


def depth(size: int) -> int:
    """How often a grid is halved: to 2 px, at most 6 times."""
    return min(MAX_DEPTH, int(math.log2(size)) - 1)


def channels(width: int, layer: int) -> int:
    """C_i: the outputs of down i."""
    return width * min(2**layer, 8)


def quantized_specs(size: int, width: int) -> dict[str, QuantizedSpec]:
    """Every tensor of a network, by name."""
    count, half = depth(size), size // 2
    specs = {
        "mask": QuantizedSpec((size, size), np.uint8),
        "down0.weight": QuantizedSpec((width, 3, 4, 4), np.float32),
        "down0.rows": QuantizedSpec((3, half, width), np.float32),
        "down0.columns": QuantizedSpec((3, half, width), np.float32),
    }
    for i in range(count):
        outputs, innermost = channels(width, i), i == count - 1
        if i > 0:
            specs[f"down{i}.weight"] = QuantizedSpec((outputs, channels(width, i - 1), 4, 4), np.int8)
            specs[f"down{i}.scale"] = _scale(outputs)
        if innermost:
            specs[f"down{i}.bias"] = QuantizedSpec((outputs,), np.float32)
        else:
            specs[f"down{i}.leaky_scale"] = _scale(outputs)
            specs[f"down{i}.leaky_zero"] = QuantizedSpec((outputs,), np.uint8)
        specs[f"down{i}.relu_scale"] = _scale(outputs)
    for i in reversed(range(count)):
        inputs = channels(width, i) * (1 if i == count - 1 else 2)
        outputs = channels(width, i - 1) if i else 3
        specs[f"up{i}.weight"] = QuantizedSpec((inputs, outputs, 4, 4), np.int8)
        specs[f"up{i}.scale"] = _scale(outputs)
        if i:
            specs[f"up{i}.relu_scale"] = _scale(outputs)
    specs["up0.bias"] = QuantizedSpec((3,), np.float32)
    return specs


def check_quantized(tensors: Mapping[str, np.ndarray], *, source: str, size: int) -> None:
    """Checks that these are the tensors of a network for a grid of `size` px.

    Args:
        tensors: By name, as they stand in the file.
        source: For error messages, `file:entry`.
        size: S.
    Raises:
        DataError: A tensor too many or too few, of a wrong dtype or shape, or with a number out of its range.
    """
    if not MIN_SIZE <= size <= MAX_SIZE or size & (size - 1):
        raise DataError(
            source, "grid size", expected=f"a power of two in [{MIN_SIZE}, {MAX_SIZE}]", found=size
        )
    first = tensors.get("down0.weight")
    width = first.shape[0] if first is not None and first.ndim == 4 else 0
    if not 1 <= width <= MAX_WIDTH:
        found = "nothing" if first is None else f"{first.dtype}{list(first.shape)}"
        raise DataError(source, "down0.weight", expected=f"float32[1 to {MAX_WIDTH}, 3, 4, 4]", found=found)
    specs = quantized_specs(size, width)
    for name in tensors:
        if name not in specs:
            raise DataError(
                source, "tensors", expected="only those of a quantised network", found=repr(name[:64])
            )
    for name, spec in specs.items():
        if name not in tensors:
            raise DataError(source, name, expected="a tensor", found="nothing")
        _check_tensor(source, name, tensors[name], spec)


def _check_tensor(source: str, name: str, value: np.ndarray, spec: QuantizedSpec) -> None:
    if value.dtype != spec.dtype or value.shape != spec.shape:
        expected = f"{np.dtype(spec.dtype)}{list(spec.shape)}"
        raise DataError(source, name, expected=expected, found=f"{value.dtype}{list(value.shape)}")
    if value.dtype != np.float32:
        return
    low, high = float(value.min()), float(value.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        raise DataError(source, name, expected="finite numbers", found="a value that is not finite")
    if low < spec.low or high > LARGEST:
        worst = low if low < spec.low else high
        raise DataError(source, name, expected=f"numbers in [{spec.low:g}, {LARGEST:g}]", found=worst)


def _scale(count: int) -> QuantizedSpec:
    return QuantizedSpec((count,), np.float32, low=SMALLEST_SCALE)
