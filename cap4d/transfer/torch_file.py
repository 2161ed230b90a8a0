"""Files of `torch.save`, read without running them, and without torch.

Such a file is a zip: `data.pkl`, a pickle that names storages by number, and the storages' bytes. A pickle is
a program that calls whatever it names; here each of the few names that checkpoints need stands for an inert
record of ours, and anything else is refused by its name. Storages are read when they are asked for, so what
nobody wants (an optimizer's state) costs nothing.
"""

from __future__ import annotations

import math
import pickle
import struct
import zipfile
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cap4d.errors import DataError
from cap4d.rig.unpickle import (
    MAX_AXES,
    NUMPY_NAMES,
    Call,
    Inert,
    NumpyRecord,
    RecordUnpickler,
    Tuple,
    numpy_value,
)

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
    *(pickle.UnpicklingError, ImportError, RecursionError, struct.error),
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

        def refuse(name: str) -> DataError:
            expected = "tensors and plain containers only"
            return DataError(self.path, "data.pkl", expected=expected, found=name)

        try:
            return _Unpickler(BytesIO(data), encoding="utf-8", names=_NAMES, refuse=refuse).load()
        except _BROKEN as error:
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
class StorageRecord(Inert):
    """What a pickle says of a storage: a key of `STORAGES`, its number, and how many values it holds."""

    kind: str
    key: str
    count: int


@dataclass(frozen=True)
class TensorRecord(Inert):
    """A tensor as a pickle has it: a view of a storage; `stride` and `offset` in values. Of at most
    `MAX_AXES` axes, and no number is below 0 or above `MAX_VALUES`.
    """

    storage: StorageRecord
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def count(self) -> int:
        """Of its values."""
        return math.prod(self.shape)


class _Dict(dict):
    """An ordered one; what it carries besides (a state dict's `_metadata`) is left aside."""

    def __setstate__(self, state: Any) -> None:
        pass


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> TensorRecord:
    """torch._utils._rebuild_tensor_v2; gradients, hooks and metadata are left aside."""
    if not isinstance(storage, StorageRecord):
        raise TypeError("a tensor without a storage")
    if not (isinstance(shape, tuple) and isinstance(stride, tuple)):
        raise TypeError("a tensor whose sizes are no tuples")
    numbers = (*shape, *stride, offset)
    if not len(shape) == len(stride) <= MAX_AXES or not all(_is_size(n) for n in numbers):
        raise ValueError("a tensor with impossible sizes, strides or offset")
    return TensorRecord(storage, offset, tuple(shape), tuple(stride))


def _is_size(number: Any) -> bool:
    return type(number) is int and 0 <= number <= MAX_VALUES


def _parameter(data: Any, *_: Any) -> Any:
    """torch._utils._rebuild_parameter: its tensor."""
    if not isinstance(data, TensorRecord):
        raise TypeError("a parameter without a tensor")
    return data


def _sizes(values: Any = ()) -> Tuple:
    """torch.Size"""
    return Tuple(values) if isinstance(values, (list, tuple)) else Tuple()


def _set(values: Any = ()) -> list:
    return list(values) if isinstance(values, (list, tuple)) else []


@dataclass(frozen=True)
class _StorageKind(Inert):
    name: str


_NAMES: dict[str, Any] = {
    "collections.OrderedDict": _Dict,
    "collections.defaultdict": Call(lambda *_: _Dict()),
    "torch._utils._rebuild_tensor_v2": Call(_tensor),
    "torch._utils._rebuild_parameter": Call(_parameter),
    "torch._utils._rebuild_parameter_with_state": Call(_parameter),
    "torch.Size": Call(_sizes),
    "builtins.set": Call(_set),
    "__builtin__.set": Call(_set),
    **{f"torch.{name}": _StorageKind(name) for name in STORAGES},
    **{f"torch.cuda.{name}": _StorageKind(name) for name in STORAGES},
    **NUMPY_NAMES,
}


_OPERATIONS = (
    *(pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.GLOBAL, pickle.STACK_GLOBAL),
    *(pickle.REDUCE, pickle.BUILD, pickle.BINPERSID, pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE),
    *(pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.BINFLOAT),
    *(pickle.BINUNICODE, pickle.SHORT_BINUNICODE, pickle.BINBYTES, pickle.SHORT_BINBYTES),
    *(pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3),
    *(pickle.EMPTY_LIST, pickle.APPEND, pickle.APPENDS),
    *(pickle.EMPTY_DICT, pickle.SETITEM, pickle.SETITEMS),
    *(pickle.BINPUT, pickle.LONG_BINPUT, pickle.MEMOIZE, pickle.BINGET, pickle.LONG_BINGET),
)
"""All that `torch.save` writes for tensors and plain containers, of any protocol from 2 on."""


class _Unpickler(RecordUnpickler):
    dispatch: ClassVar = {code[0]: RecordUnpickler.dispatch[code[0]] for code in _OPERATIONS}

    def persistent_load(self, pid: Any) -> StorageRecord:
        """("storage", kind, key, device, count); where the tensor was (`cuda:0`) does not matter."""
        word, kind, key, _, count = pid
        known = isinstance(kind, _StorageKind) and isinstance(key, str) and key.isascii() and key.isdigit()
        if word != "storage" or not known or not _is_size(count):
            raise TypeError("a storage of another kind")
        return StorageRecord(kind.name, key, count)


def _view(storage: np.ndarray, record: TensorRecord) -> np.ndarray:
    """The storage as the tensor sees it.

    Raises:
        ValueError: It reaches beyond the storage, or repeats it.
    """
    shape, stride, offset = record.shape, record.stride, record.offset
    if record.count > len(storage):
        raise ValueError(f"sizes {shape} of {len(storage)} numbers")
    last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
    if 0 not in shape and last >= len(storage):
        raise ValueError(f"sizes {shape} and strides {stride} beyond {len(storage)} numbers")
    if 0 in shape:
        return np.zeros(shape, storage.dtype)
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False)
