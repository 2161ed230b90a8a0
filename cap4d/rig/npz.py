"""NumPy archives from outside: plain arrays only, every size checked before it is believed. Errors are
one-line DataErrors.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Callable, Collection
from pathlib import Path
from tokenize import TokenError
from typing import BinaryIO

import numpy as np

from cap4d.atomic import replacing
from cap4d.errors import DataError

MAX_NPZ_BYTES = 1 << 29  # unpacked; no head model and no sequence of an hour comes near
MAX_NPY_BYTES = 1 << 31  # half an hour of FLAME's vertices at 30 fps
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # all that NumPy writes
_KINDS = {"float": "f", "index": "iu", "number": "fiu", "text": "U", "bool": "b"}

# What NumPy and zipfile raise on files that are cut, corrupt, encrypted, or hold something else.
_BROKEN = (
    *(OSError, ValueError, EOFError, KeyError, TypeError, AttributeError, NotImplementedError, RuntimeError),
    *(MemoryError, OverflowError, SyntaxError, TokenError, zipfile.BadZipFile, zlib.error),
    zipfile.LargeZipFile,
)


def read_npz(
    path: Path, *, names: Collection[str] | None = None, max_bytes: int = MAX_NPZ_BYTES
) -> dict[str, np.ndarray]:
    """The arrays of an .npz file.

    Args:
        names: Read only these (those that are there); the rest of the file is not unpacked. None: all.
        max_bytes: Of all that is read, unpacked.
    Raises:
        DataError: Not an archive, damaged, too large, with objects in it, or with a member whose header and
            size disagree.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = [
                (info.filename[:-4], info)
                for info in archive.infolist()
                if info.filename.endswith(".npy") and (names is None or info.filename[:-4] in names)
            ]
            _check_size(path, sum(info.file_size for _, info in members), max_bytes)
            return {name: _read_member(path, name, archive, info) for name, info in members}
    except FileNotFoundError as error:
        raise DataError(path, "file", expected="an .npz archive", found="no such file") from error
    except _BROKEN as error:
        raise DataError(path, "archive", expected="an .npz of plain arrays", found=_reason(error)) from error


def read_npy(path: Path, *, max_bytes: int = MAX_NPY_BYTES) -> np.ndarray:
    """The array of an .npy file, under the same conditions as `read_npz`."""
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            size = path.stat().st_size
            _check_size(path, size, max_bytes)
            return _read_array(path, "array", stream, size)
    except FileNotFoundError as error:
        raise DataError(path, "file", expected="an .npy array", found="no such file") from error
    except _BROKEN as error:
        raise DataError(path, "array", expected="an .npy of plain values", found=_reason(error)) from error


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an .npz through a temporary file, so that `path` is either whole or untouched."""
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def checked(
    source: Path, name: str, array: np.ndarray | None, *, kind: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """The array if it is finite and of the kind (a key of `_KINDS`) and shape (None: any length).

    Raises:
        DataError: Naming the file, the array, what was expected and what was found.
    """
    expected = f"{kind}[{', '.join('*' if n is None else str(n) for n in shape)}]"
    if array is None:
        raise DataError(source, name, expected=expected, found="nothing")
    matches = len(shape) == array.ndim and all(
        n in (None, m) for n, m in zip(shape, array.shape, strict=True)
    )
    if not matches or array.dtype.kind not in _KINDS[kind]:
        raise DataError(source, name, expected=expected, found=f"{array.dtype}{list(array.shape)}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise DataError(
            source, name, expected="finite values", found=f"{(~np.isfinite(array)).sum()} that are not"
        )
    return array


def checked_float32(
    source: Path, name: str, array: np.ndarray | None, *, shape: tuple[int | None, ...]
) -> np.ndarray:
    """float32 of the array if it holds numbers of this shape that are finite in float32; else DataError."""
    array = checked(source, name, array, kind="number", shape=shape)
    with np.errstate(over="ignore"):
        value = np.ascontiguousarray(array, np.float32).reshape(array.shape)
    if not np.isfinite(value).all():
        raise DataError(source, name, expected="finite float32 values", found="a number beyond them")
    return value


def checked_indices(
    source: Path, name: str, array: np.ndarray | None, *, shape: tuple[int | None, ...], below: int
) -> np.ndarray:
    """int32 of the array if it holds indices in [0, below); otherwise DataError."""
    array = checked(source, name, array, kind="index", shape=shape)
    if array.size and (int(array.min()) < 0 or int(array.max()) >= below):
        worst = int(array.min()) if int(array.min()) < 0 else int(array.max())
        raise DataError(source, name, expected=f"indices 0 to {below - 1}", found=worst)
    return np.ascontiguousarray(array, np.int32)


def _check_size(path: Path, size: int, limit: int) -> None:
    if size > limit:
        raise DataError(path, "size", expected=f"at most {limit} bytes unpacked", found=size)


def _read_member(path: Path, name: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    if info.compress_type not in METHODS:
        raise DataError(path, name, expected="stored or deflated", found=f"method {info.compress_type}")
    try:
        with archive.open(info) as stream:
            return _read_array(path, name, stream, info.file_size)
    except _BROKEN as error:
        raise DataError(path, name, expected="a plain array", found=_reason(error)) from error


def _read_array(path: Path, name: str, stream: BinaryIO, size: int) -> np.ndarray:
    shape, fortran, dtype = _read_header(path, name, stream)
    wanted, left = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if wanted != left:
        expected = f"{wanted} bytes for {dtype}{list(shape)}"
        raise DataError(path, name, expected=expected, found=f"{left} bytes")
    data = stream.read(wanted)
    if len(data) != wanted:
        raise DataError(path, name, expected=f"{wanted} bytes", found=len(data))
    array = np.frombuffer(bytearray(data), dtype)
    if dtype.kind == "U":
        _check_text(path, name, array)
    return array.reshape(shape, order="F" if fortran else "C")


def _read_header(path: Path, name: str, stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    readers: dict[tuple[int, int], Callable] = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise DataError(path, name, expected="version 1 or 2 of the .npy format", found=version)
    shape, fortran, dtype = readers[version](stream)
    plain = dtype.kind in "biufU" and dtype.subdtype is None and dtype.itemsize > 0
    if not plain:
        raise DataError(path, name, expected="plain numbers or text", found=f"dtype {dtype}")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise DataError(path, name, expected="sizes of at least 0", found=shape)
    return shape, fortran, dtype


def _check_text(path: Path, name: str, array: np.ndarray) -> None:
    """Refuses numbers that are no characters; NumPy notices only when it makes Python strings of them."""
    codes = array.view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
    if ((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))).any():
        raise DataError(path, name, expected="text", found="numbers that are no characters")


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
