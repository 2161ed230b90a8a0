"""How packed tensors lie in a file: float32, float16 or int8, and bases without the points that stay put.

An int8 tensor NAME has a companion `NAME.steps`, a step and an offset for each row or column of it. A masked
basis NAME has a companion `NAME.mask`, a bit for each row and point, and holds only the points whose bit is
set. FORMAT.md, section 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from cap4d.bundle.schema import TENSORS, TensorSpec, stored_shape
from cap4d.errors import DataError

Form = Literal["float32", "float16", "int8"]
FORMS: tuple[Form, ...] = ("float32", "float16", "int8")
STEPS, MASK = ".steps", ".mask"
COMPANIONS = (STEPS, MASK)
LEVELS = 127  # an int8 tensor uses -127 to 127: as many levels above its offset as below


def pack(name: str, values: np.ndarray, spec: TensorSpec, form: Form) -> dict[str, np.ndarray]:
    """`values` in a form, with companions; a basis is masked where that makes it smaller.

    Float16 overflows to infinity, which the checks refuse.
    """
    stored = _quantize(name, values, spec) if form == "int8" else {name: _cast(values, form)}
    if spec.steps == "row":
        moved = stored[name].any(-1)
        bits = np.packbits(moved, axis=1, bitorder="little")
        kept = stored[name][moved]
        if bits.nbytes + kept.nbytes < stored[name].nbytes:
            stored |= {name: kept, name + MASK: bits}
    return stored


def rounded(values: np.ndarray, spec: TensorSpec, form: Form) -> np.ndarray:
    """float32: what `values` come back as once they were stored in a form."""
    if form != "int8":
        return _cast(values, form).astype(np.float32)
    stored = _quantize("x", values, spec)
    return _dequantize(stored["x"], stored["x" + STEPS], spec.steps)


def unpack(
    source: str,
    entry: str,
    stored: Mapping[str, np.ndarray],
    *,
    counts: Mapping[str, int],
    precision: str,
    version: int,
) -> dict[str, np.ndarray]:
    """The tensors of a file without companions: int8 ones widened to float32, masked ones filled with zeros.

    What has no companion passes as it is; `schema.check_tensors` must follow.

    Raises:
        DataError: A companion without its tensor or of another dtype or shape, or not as FORMAT.md says.
    """
    where, specs = f"{source}:{entry}", TENSORS[entry]
    tensors = {name: value for name, value in stored.items() if not name.endswith(COMPANIONS)}
    for companion in sorted(set(stored) - set(tensors)):
        name, _, kind = companion.rpartition(".")
        spec = specs.get(name)
        packed = version >= 2 and spec is not None and spec.kind == "packed" and name in tensors
        if not packed or ("." + kind == MASK and spec.steps != "row"):
            expected = "from version 2 on, companions of packed tensors that are there (masks: of bases)"
            raise DataError(where, "tensors", expected=expected, found=repr(companion[:64]))
    for name, value in tensors.items():
        if (name + STEPS) in stored or (name + MASK) in stored:
            packed = _Packed(where, name, specs[name], counts)
            steps, mask = (stored.get(name + companion) for companion in COMPANIONS)
            tensors[name] = packed.unpack(value, steps, mask, precision)
    return tensors


class _Packed:
    """One packed tensor with companions."""

    def __init__(self, where: str, name: str, spec: TensorSpec, counts: Mapping[str, int]) -> None:
        self.where, self.name, self.spec = where, name, spec
        self.shape = stored_shape(spec, counts)

    def unpack(
        self, value: np.ndarray, steps: np.ndarray | None, mask: np.ndarray | None, precision: str
    ) -> np.ndarray:
        """All sizes are checked before anything of the full shape is made."""
        flags = None
        if mask is not None:
            points = self.shape[1]
            self._expect(MASK, mask, np.uint8, (self.shape[0], -(-points // 8)))
            bits = np.unpackbits(mask, axis=1, bitorder="little")
            if bits[:, points:].any():
                self._refuse(MASK, f"zero bits after the first {points}", "another")
            flags = bits[:, :points].astype(bool)
            kept = (int(np.count_nonzero(flags)), self.shape[2])
            self._expect("", value, value.dtype, kept)
        if steps is not None:
            if precision != "mixed":
                self._refuse(STEPS, f"none at precision {precision}", "a tensor")
            self._expect("", value, np.int8, self.shape if flags is None else value.shape)
            by_row = self.spec.steps == "row"
            lead = self.shape[:1] if by_row else self.shape[1:]
            self._expect(STEPS, steps, np.float32, (*lead, 2))
            if not np.isfinite(steps).all() or (steps[..., 0] < 0).any():
                self._refuse(STEPS, "finite numbers, steps of at least 0", "another")
            if flags is not None:
                steps = steps[np.nonzero(flags)[0]]  # one a point that is there
            value = _dequantize(value, steps, self.spec.steps)
        if flags is None:
            return value
        full = np.zeros(self.shape, value.dtype)
        full[flags] = value
        return full

    def _expect(self, companion: str, value: np.ndarray, dtype: object, shape: tuple[int, ...]) -> None:
        if value.dtype != dtype or value.shape != shape:
            expected = f"{np.dtype(dtype)}{list(shape)}"
            self._refuse(companion, expected, f"{value.dtype}{list(value.shape)}")

    def _refuse(self, companion: str, expected: str, found: str) -> None:
        raise DataError(self.where, self.name + companion, expected=expected, found=found)


def _cast(values: np.ndarray, form: str) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values, np.dtype(form))


def _quantize(name: str, values: np.ndarray, spec: TensorSpec) -> dict[str, np.ndarray]:
    """int8 and steps. A basis has offset 0, so that what stays put does so exactly."""
    values = np.ascontiguousarray(values, np.float32)  # a safetensors writer takes bytes as they lie
    axes = tuple(range(1, values.ndim)) if spec.steps == "row" else (0,)
    low, high = values.min(axes), values.max(axes)
    if spec.steps == "row":
        offset, reach = np.zeros_like(high), np.maximum(-low, high)
    else:
        offset, reach = (low + high) / 2, (high - low) / 2
    steps = np.stack([reach / LEVELS, offset], -1).astype(np.float32)
    step, offset = _broadcast(steps, spec.steps, values.ndim)
    levels = np.rint((values - offset) / np.where(step > 0, step, 1))
    with np.errstate(invalid="ignore"):
        return {name: np.clip(levels, -LEVELS, LEVELS).astype(np.int8), name + STEPS: steps}


def _dequantize(levels: np.ndarray, steps: np.ndarray, kind: str) -> np.ndarray:
    """float32: offset + step * level, rounded after each of the two."""
    step, offset = _broadcast(steps, kind, levels.ndim)
    with np.errstate(over="ignore", invalid="ignore"):
        return levels.astype(np.float32) * step + offset


def _broadcast(steps: np.ndarray, kind: str, ndim: int) -> tuple[np.ndarray, np.ndarray]:
    """Step and offset, each shaped to go with the tensor."""
    shape = (-1, *[1] * (ndim - 1)) if kind == "row" else steps.shape[:-1]
    return steps[..., 0].reshape(shape), steps[..., 1].reshape(shape)
