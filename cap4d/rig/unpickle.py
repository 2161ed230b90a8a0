"""Pickles of head models, read without running them.

A pickle is a program that calls whatever it names. Here each of the few names such files need stands for an
inert record of ours, and anything else is refused by its name; no module a file names is ever imported. The
records become NumPy arrays after reading, through `np.frombuffer` alone.
"""

from __future__ import annotations

import math
import pickle
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from cap4d.errors import DataError

MAX_BYTES = 1 << 30
MAX_AXES = 8


def read_pickle(path: Path) -> dict[str, Any]:
    """The dictionary in a pickle: arrays (NumPy's, chumpy's, SciPy's sparse ones made dense), text and
    numbers.

    Raises:
        DataError: Naming the class or what else is wrong.
    """
    path = Path(path)

    def refuse(name: str) -> DataError:
        return DataError(path, "pickle", expected="NumPy, SciPy or chumpy arrays only", found=name)

    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(path, "size", expected=f"at most {MAX_BYTES} bytes", found=path.stat().st_size)
        with open(path, "rb") as stream:
            content = RecordUnpickler(stream, encoding="latin1", names=_NAMES, refuse=refuse).load()
    except OSError as error:
        raise DataError(path, "file", expected="a pickle", found=error.strerror) from error
    except _BROKEN as error:
        raise DataError(path, "pickle", expected="a whole and plain pickle", found=repr(error)) from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise DataError(path, "pickle", expected="a dictionary with text keys", found=type(content).__name__)
    return {key: _plain(path, key, value) for key, value in content.items()}


class Tuple(tuple):
    """A tuple that is no key. Hashing tuples that share tuples takes twice as long a level."""

    __slots__ = ()
    __hash__ = None


Tuple.__name__ = "tuple"  # as messages call it


class Inert:
    """Nothing that a pickle is given can be given a state: it may be there for the next pickle, too."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise TypeError("a state for what has none")


class Call(Inert):
    """Something that a pickle may call: a function of ours."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable) -> None:
        self._make = make

    def __call__(self, *args: Any) -> Any:
        return self._make(*args)


def _with_tuple(load: Callable) -> Callable:
    """An operation that leaves a tuple on top of the stack, with ours in its place."""

    def loaded(unpickler: RecordUnpickler) -> None:
        load(unpickler)
        unpickler.stack[-1] = Tuple(unpickler.stack[-1])

    return loaded


_TUPLES = (pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3)


class RecordUnpickler(pickle._Unpickler):
    """Python's own in Python, not in C: that one makes its memo as long as the largest number that a file
    names, so that five bytes take gigabytes. Files are small in operations: their arrays are one each.

    Args:
        names: What a pickle may name, and what stands for it.
        refuse: Makes the error for another name.
    """

    dispatch: ClassVar = pickle._Unpickler.dispatch | {
        code[0]: _with_tuple(pickle._Unpickler.dispatch[code[0]]) for code in _TUPLES
    }

    def __init__(
        self, stream: BinaryIO, *, encoding: str, names: dict[str, Any], refuse: Callable[[str], Exception]
    ) -> None:
        super().__init__(stream, encoding=encoding)
        self._names, self._refuse = names, refuse

    def find_class(self, module: str, name: str) -> Any:
        full_name = f"{module}.{name}"
        if full_name not in self._names:
            raise self._refuse(full_name[:120])
        return self._names[full_name]


class _Record:
    """Keeps what a pickle wants to build something from."""

    def __init__(self, *args: Any) -> None:
        self.args, self.state = args, None

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __reduce__(self) -> Any:
        raise TypeError("a record of a pickle is not for pickling")


class _Dtype(_Record):
    pass


class NumpyRecord(_Record):
    """A NumPy array, or one number of NumPy's; see `numpy_value`."""


class _Array(NumpyRecord):
    pass


class _Scalar(NumpyRecord):
    pass


class _Columns(_Record):
    """A csc matrix."""


class _Rows(_Record):
    """A csr matrix."""


class _Chumpy(_Record):
    pass


def _encode(text: str, encoding: str) -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise ValueError(f"text encoded as {encoding!r}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Old protocols write empty bytes as a call of `bytes` without arguments."""
    return b""


def _reconstruct(kind: type, *_: Any) -> _Record:
    if not (isinstance(kind, type) and issubclass(kind, _Record)):
        raise TypeError("an object of no known class")
    return kind()


NUMPY_NAMES: dict[str, Any] = {
    "numpy.dtype": _Dtype,
    "numpy.ndarray": _Array,
    "numpy.core.multiarray._reconstruct": Call(_reconstruct),
    "numpy._core.multiarray._reconstruct": Call(_reconstruct),
    "numpy.core.multiarray.scalar": _Scalar,
    "numpy._core.multiarray.scalar": _Scalar,
    "_codecs.encode": Call(_encode),
    "__builtin__.bytes": Call(_no_bytes),
    "builtins.bytes": Call(_no_bytes),
}
"""What a pickle may name for arrays and numbers of NumPy's."""

_NAMES: dict[str, Any] = NUMPY_NAMES | {
    "copy_reg._reconstructor": Call(_reconstruct),
    "copyreg._reconstructor": Call(_reconstruct),
    "__builtin__.object": _Record,
    "builtins.object": _Record,
    "__builtin__.set": _Record,
    "builtins.set": _Record,
    "chumpy.ch.Ch": _Chumpy,
}
_NAMES |= {f"scipy.sparse.{module}.csc_matrix": _Columns for module in ("csc", "_csc")}
_NAMES |= {f"scipy.sparse.{module}.csr_matrix": _Rows for module in ("csr", "_csr")}

_MISFITS = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError)
_BROKEN = (
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)


def numpy_value(path: Path, key: str, record: NumpyRecord) -> np.ndarray:
    """The array that a record of NumPy's describes; a number is one without dimensions.

    Raises:
        DataError: Naming `key`: it does not fit together, or is not of plain numbers.
    """
    try:
        return _number(record) if isinstance(record, _Scalar) else _array(record)
    except _MISFITS as error:
        raise DataError(path, key, expected="an array", found=repr(error)) from error


def _plain(path: Path, key: str, value: Any) -> Any:
    try:
        if isinstance(value, _Chumpy):
            value = value.state["x"]
        if isinstance(value, _Array):
            return _array(value)
        if isinstance(value, (_Columns, _Rows)):
            return _dense(value)
    except _MISFITS as error:
        raise DataError(path, key, expected="an array", found=repr(error)) from error
    return value if isinstance(value, (str, bytes, int, float)) else None


def _number(record: _Scalar) -> np.ndarray:
    """NumPy's own arguments: (dtype, bytes)."""
    dtype, data = record.args
    element = _element(dtype)
    if not isinstance(data, bytes) or len(data) != element.itemsize:
        raise ValueError(f"one {element} in {len(data)} bytes")
    return np.frombuffer(bytearray(data), element).reshape(())


def _array(record: _Array) -> np.ndarray:
    """NumPy's own state: (version, shape, dtype, is Fortran order, bytes)."""
    _, shape, dtype, fortran, data = record.state
    data = data.encode("latin1") if isinstance(data, str) else data
    element = _element(dtype)
    if not isinstance(shape, tuple) or len(shape) > MAX_AXES or not all(type(n) is int for n in shape):
        raise ValueError("a shape of other than some whole numbers")
    if (
        not isinstance(data, bytes)
        or math.prod(shape) * element.itemsize != len(data)
        or min(shape, default=0) < 0
    ):
        raise ValueError(f"shape {tuple(shape)} of {element} in {len(data)} bytes")
    return np.frombuffer(bytearray(data), element).reshape(shape, order="F" if fortran else "C")


def _element(record: _Dtype) -> np.dtype:
    """A number type; NumPy's state of it begins with (version, byte order)."""
    code, order = record.args[0], record.state[1]
    if not (isinstance(code, str) and isinstance(order, str)):
        raise TypeError("elements of a type without a name")
    if not re.fullmatch(r"[fiu][1248]|b1", code) or order not in ("<", ">", "|", "="):
        raise ValueError(f"elements of type {order[:8]}{code[:8]}")
    return np.dtype(order + code)


def _dense(record: _Columns | _Rows) -> np.ndarray:
    """A compressed sparse matrix as a dense one: data and indices between indptr[i] and indptr[i + 1] belong
    to line i.
    """
    state = record.state
    data, indices, indptr = (_array(state[name]) for name in ("data", "indices", "indptr"))
    shape = tuple(int(n) for n in state.get("_shape", state.get("shape")))
    lines, width = shape[::-1] if isinstance(record, _Columns) else shape
    if not 0 < lines * width <= MAX_BYTES // 8 or len(indptr) != lines + 1:
        raise ValueError(f"sparse matrix of shape {shape}")
    counts = np.diff(indptr.astype(np.int64))
    if (counts < 0).any() or indptr[0] != 0 or indptr[-1] != len(data) or len(indices) != len(data):
        raise ValueError("sparse matrix with bad line starts")
    if len(indices) and not 0 <= indices.min() <= indices.max() < width:
        raise ValueError("sparse matrix with an index out of range")
    dense = np.zeros((lines, width))
    np.add.at(dense, (np.repeat(np.arange(lines), counts), indices), data)
    return dense.T if isinstance(record, _Columns) else dense
