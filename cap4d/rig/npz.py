"""NumPy archives from outside: plain arrays only, every size checked before it is believed. Errors are
one-line DataErrors.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from tokenize import TokenError

import numpy as np

from cap4d.atomic import replacing
from cap4d.errors import DataError

MAX_MEMBER_BYTES = 1 << 31  # the largest array of any head model is some hundred megabytes
_KINDS = {"float": "f", "index": "iu", "text": "U", "bool": "b"}


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz file.

    Raises:
        DataError: Not an archive, damaged, with objects in it, or with a member whose header and size
            disagree.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            names = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            return {info.filename[:-4]: _read_member(path, archive, info) for info in names}
    except FileNotFoundError as error:
        raise DataError(path, "file", expected="an .npz archive", found="no such file") from error
    except (
        zipfile.BadZipFile,
        zipfile.LargeZipFile,
        OSError,
        EOFError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise DataError(path, "archive", expected="a readable .npz", found=error) from error


def read_npy(path: Path) -> np.ndarray:
    """The array of an .npy file, under the same conditions as `read_npz`."""
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            return _read_array(path, path.name, stream, path.stat().st_size)
    except OSError as error:
        raise DataError(path, "file", expected="an .npy array", found=error.strerror) from error


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an .npz through a temporary file, so that `path` is either whole or untouched."""
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def checked(
    source: Path, name: str, array: np.ndarray | None, *, kind: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """The array if it is of the kind (`float`, `index`, `text`, `bool`), shape (None: any length) and finite.

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
    if kind == "float" and not np.isfinite(array).all():
        raise DataError(
            source, name, expected="finite values", found=f"{(~np.isfinite(array)).sum()} that are not"
        )
    return array


def checked_indices(
    source: Path, name: str, array: np.ndarray | None, *, shape: tuple[int | None, ...], below: int
) -> np.ndarray:
    """int32 of the array if it holds indices in [0, below); otherwise DataError."""
    array = checked(source, name, array, kind="index", shape=shape)
    if array.size and (int(array.min()) < 0 or int(array.max()) >= below):
        worst = int(array.min()) if int(array.min()) < 0 else int(array.max())
        raise DataError(source, name, expected=f"indices 0 to {below - 1}", found=worst)
    return np.ascontiguousarray(array, np.int32)


def _read_member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as stream:
        return _read_array(path, info.filename[:-4], stream, info.file_size)


def _read_array(path: Path, name: str, stream, size: int) -> np.ndarray:
    if size > MAX_MEMBER_BYTES:
        raise DataError(path, name, expected=f"at most {MAX_MEMBER_BYTES} bytes", found=size)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = read_header(stream)
    except (ValueError, KeyError, EOFError, TypeError, SyntaxError, TokenError, RecursionError) as error:
        raise DataError(path, name, expected="a NumPy array header", found=error) from error
    if dtype.hasobject or dtype.names:
        raise DataError(path, name, expected="plain numbers or text", found=f"dtype {dtype}")
    count = math.prod(shape)
    if any(n < 0 for n in shape) or count * dtype.itemsize != size - stream.tell():
        found = f"{size - stream.tell()} bytes"
        raise DataError(
            path, name, expected=f"{count * dtype.itemsize} bytes for {dtype}{list(shape)}", found=found
        )
    data = stream.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise DataError(path, name, expected=f"{count * dtype.itemsize} bytes", found=len(data))
    return np.frombuffer(bytearray(data), dtype).reshape(shape, order="F" if fortran else "C")
