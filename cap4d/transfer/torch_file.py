"""Files of `torch.save`, read without running them, and without torch.

Such a file is a zip: `data.pkl`, a pickle that names storages by number, and the storages' bytes. A pickle is
a program that calls whatever it names; here each of the few names that checkpoints need stands for an inert
record of ours, and anything else is refused by its name. Storages are read when they are asked for, so what
nobody wants (an optimizer's state) costs nothing.
"""

from __future__ import annotations

import math
import pickle
import zipfile
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.errors import DataError
from cap4d.rig.unpickle import NUMPY_NAMES, NumpyRecord, numpy_value

MAX_BYTES = 1 << 33
MAX_PICKLE_BYTES = 1 << 24  # a checkpoint's is some kilobytes
MAX_ENTRIES = 1 << 16
MAX_VALUES = 1 << 28  # of one tensor
LEGACY_MAGIC = bytes.fromhex("8a0a6cfc9c46f9206aa85019")  # what torch began its files with before 1.6

STORAGES = {
    **{"DoubleStorage": "f8", "FloatStorage": "f4", "HalfStorage": "f2", "LongStorage": "i8"},
    **{"IntStorage": "i4", "ShortStorage": "i2", "CharStorage": "i1", "ByteStorage": "u1"},
    "BoolStorage": "b1",
}
"""torch's names of storages -> NumPy's of their numbers."""

_BROKEN = (
    *(OSError, ValueError, EOFError, LookupError, TypeError, AttributeError, NotImplementedError),
    *(RuntimeError, MemoryError, ArithmeticError, zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error),
    *(pickle.UnpicklingError, ImportError),
)


class TorchFile:
    """An open checkpoint. A context manager.

    `content` is what was saved: dicts, lists, tuples, text, numbers, None, and `TensorRecord` or NumPy
    records for arrays, which `array` reads.

    Raises:
        DataError: Not such a file, damaged, too large, or its pickle names anything but tensors, NumPy
            arrays and plain containers.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._check_kind()
            self._zip = zipfile.ZipFile(self.path)
        except _BROKEN as error:
            raise self._broken("file", "a zip, as torch.save writes", error) from error
        try:
            self._members = self._checked_members()
            self._order = self._byte_order()
            self.content = self._load()
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> TorchFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def array(self, field: str, value: Any) -> np.ndarray:
        """A tensor or a NumPy array of `content`, in memory of its own.

        Raises:
            DataError: Naming `field`: it is neither, or reaches beyond its storage, or that is damaged.
        """
        if isinstance(value, NumpyRecord):
            return numpy_value(self.path, field, value)
        if not isinstance(value, TensorRecord):
            raise DataError(self.path, field, expected="a tensor", found=type(value).__name__)
        storage = self._storage(field, value.storage)
        try:
            view = _view(storage, value)
        except (ValueError, TypeError, OverflowError) as error:
            raise DataError(self.path, field, expected="a tensor", found=error) from error
        return np.array(view, order="C")

    def _check_kind(self) -> None:
        size = self.path.stat().st_size
        if size > MAX_BYTES:
            raise DataError(self.path, "size", expected=f"at most {MAX_BYTES} bytes", found=size)
        with open(self.path, "rb") as stream:
            start = stream.read(16)
        if LEGACY_MAGIC in start:
            expected = "a zip (write it again with torch 1.6 or newer)"
            raise DataError(self.path, "file", expected=expected, found="torch's old format")

    def _checked_members(self) -> dict[str, zipfile.ZipInfo]:
        """By their names below the archive's one folder."""
        members = self._zip.infolist()
        if len(members) > MAX_ENTRIES:
            raise DataError(self.path, "zip", expected=f"at most {MAX_ENTRIES} entries", found=len(members))
        roots = {info.filename.split("/")[0] for info in members}
        if len(roots) != 1:
            raise DataError(self.path, "zip", expected="one folder", found=", ".join(sorted(roots)[:4]) or 0)
        return {info.filename.partition("/")[2]: info for info in members}

    def _byte_order(self) -> str:
        if "byteorder" not in self._members:
            return "<"
        named = self._read("byteorder", limit=16)
        if named not in (b"little", b"big"):
            raise DataError(self.path, "byteorder", expected="little or big", found=named)
        return "<" if named == b"little" else ">"

    def _load(self) -> Any:
        data = self._read("data.pkl", limit=MAX_PICKLE_BYTES)
        try:
            return _Unpickler(data, self.path).load()
        except (*_BROKEN, RecursionError) as error:
            raise self._broken("data.pkl", "tensors and plain containers", error) from error

    def _storage(self, field: str, record: StorageRecord) -> np.ndarray:
        dtype = np.dtype(STORAGES[record.kind]).newbyteorder(self._order)
        name, wanted = f"data/{record.key}", record.count * dtype.itemsize
        if name in self._members and self._members[name].file_size != wanted:
            found = f"{self._members[name].file_size} bytes"
            expected = f"{wanted} bytes for {record.count} numbers"
            raise DataError(self.path, f"{field}: {name}", expected=expected, found=found)
        data = self._read(name, limit=wanted, field=field)
        return np.frombuffer(data, dtype)

    def _read(self, name: str, *, limit: int, field: str = "zip") -> bytes:
        info = self._members.get(name)
        if info is None:
            raise DataError(self.path, field, expected=f"an entry {name}", found="none")
        if info.compress_type != zipfile.ZIP_STORED or not 0 <= info.file_size <= limit:
            expected, found = f"at most {limit} bytes, stored", f"{info.file_size}, by {info.compress_type}"
            raise DataError(self.path, f"{field}: {name}", expected=expected, found=found)
        try:
            return self._zip.read(info)
        except _BROKEN as error:
            raise self._broken(f"{field}: {name}", "whole", error) from error

    def _broken(self, field: str, expected: str, error: BaseException) -> DataError:
        if isinstance(error, DataError):
            return error
        reason = error.strerror if isinstance(error, OSError) else str(error)
        return DataError(self.path, field, expected=expected, found=(reason or type(error).__name__)[:120])


@dataclass(frozen=True)
class StorageRecord:
    """What a pickle says of a storage: a key of `STORAGES`, its number, and how many values it holds."""

    kind: str
    key: str
    count: int


@dataclass(frozen=True)
class TensorRecord:
    """A tensor as a pickle has it: a view of a storage; `stride` and `offset` in values."""

    storage: StorageRecord
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


class _Dict(dict):
    """An ordered one; what it carries besides (a state dict's `_metadata`) is left aside."""

    def __setstate__(self, state: Any) -> None:
        pass


class _Call:
    """Something that a pickle may call: a function of ours. Nothing can be set on it."""

    __slots__ = ("_make",)

    def __init__(self, make) -> None:
        object.__setattr__(self, "_make", make)

    def __call__(self, *args: Any) -> Any:
        return self._make(*args)

    def __setattr__(self, name: str, value: Any) -> None:
        raise TypeError("a state for a function")

    def __setstate__(self, state: Any) -> None:
        raise TypeError("a state for a function")


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> TensorRecord:
    """torch._utils._rebuild_tensor_v2; gradients, hooks and metadata are left aside."""
    if not isinstance(storage, StorageRecord):
        raise TypeError("a tensor without a storage")
    if not (isinstance(shape, tuple) and isinstance(stride, tuple)):
        raise TypeError("a tensor whose sizes are no tuples")
    return TensorRecord(storage, offset, shape, stride)


def _parameter(data: Any, *_: Any) -> Any:
    """torch._utils._rebuild_parameter: its tensor."""
    if not isinstance(data, TensorRecord):
        raise TypeError("a parameter without a tensor")
    return data


def _sizes(values: Any = ()) -> tuple:
    """torch.Size"""
    return tuple(values) if isinstance(values, (list, tuple)) else ()


def _set(values: Any = ()) -> list:
    return list(values) if isinstance(values, (list, tuple)) else []


@dataclass(frozen=True)
class _StorageKind:
    name: str


_NAMES: dict[str, Any] = {
    "collections.OrderedDict": _Dict,
    "collections.defaultdict": _Call(lambda *_: _Dict()),
    "torch._utils._rebuild_tensor_v2": _Call(_tensor),
    "torch._utils._rebuild_parameter": _Call(_parameter),
    "torch._utils._rebuild_parameter_with_state": _Call(_parameter),
    "torch.Size": _Call(_sizes),
    "builtins.set": _Call(_set),
    "__builtin__.set": _Call(_set),
    **{f"torch.{name}": _StorageKind(name) for name in STORAGES},
    **{f"torch.cuda.{name}": _StorageKind(name) for name in STORAGES},
    **NUMPY_NAMES,
}


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, path: Path) -> None:
        super().__init__(BytesIO(data), encoding="utf-8")
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        full_name = f"{module}.{name}"
        if full_name not in _NAMES:
            expected = "tensors and plain containers only"
            raise DataError(self._path, "data.pkl", expected=expected, found=full_name[:120])
        return _NAMES[full_name]

    def persistent_load(self, pid: Any) -> StorageRecord:
        """("storage", kind, key, device, count); where the tensor was (`cuda:0`) does not matter."""
        word, kind, key, _, count = pid
        known = isinstance(kind, _StorageKind) and isinstance(key, str) and key.isascii() and key.isdigit()
        if word != "storage" or not known or type(count) is not int or not 0 <= count <= MAX_VALUES:
            raise TypeError("a storage of another kind")
        return StorageRecord(kind.name, key, count)


def _view(storage: np.ndarray, record: TensorRecord) -> np.ndarray:
    """The storage as the tensor sees it.

    Raises:
        ValueError: It reaches beyond the storage, or repeats it.
    """
    shape, stride, offset = record.shape, record.stride, record.offset
    numbers = (*shape, *stride, offset)
    if not all(type(n) is int and 0 <= n <= MAX_VALUES for n in numbers) or len(shape) != len(stride):
        raise ValueError(f"sizes {shape}, strides {stride}, offset {offset}")
    if len(shape) > 8 or math.prod(shape) > len(storage):
        raise ValueError(f"sizes {shape} of {len(storage)} numbers")
    last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
    if 0 not in shape and last >= len(storage):
        raise ValueError(f"sizes {shape} and strides {stride} beyond {len(storage)} numbers")
    if 0 in shape:
        return np.zeros(shape, storage.dtype)
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False)
