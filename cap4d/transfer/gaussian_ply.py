"""The PLY that 3D Gaussian Splatting writes, with the triangle each Gaussian is bound to (fact 45).

Own reader of exactly that: one element, `vertex`, of scalar properties, binary little endian, and not a byte
more or less than the header promises.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from cap4d.bundle.schema import COUNTS
from cap4d.errors import DataError
from cap4d.gaussians import SH_COUNTS
from cap4d.transfer.raw_gaussians import check_gaussians

MAX_HEADER_BYTES, MAX_PROPERTIES = 1 << 16, 256
CHECKED = {
    "x to z": "means",
    "rot_0 to rot_3": "quats",
    "scale_0 to scale_2": "log_scales",
    "opacity": "opacity_logits",
    "f_dc_*, f_rest_*": "sh",
}
"""Properties -> a bundle's tensor."""
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"},
    **{"float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"},
}


@dataclass(frozen=True, eq=False)
class BoundGaussians:
    """N raw Gaussians in the frames of their triangles (facts 26, 27), and int32[N] which those are.

    Names and shapes are those of a bundle: means, quats, log_scales, opacity_logits, sh [N, S, 3].
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    binding: np.ndarray

    def __len__(self) -> int:
        return len(self.means)


def read_gaussian_ply(path: Path, *, faces: int) -> BoundGaussians:
    """Reads and checks a file.

    Args:
        faces: Triangles that they may be bound to.
    Raises:
        DataError: Naming the property, what was expected and what was found.
    """
    columns = _Columns(path, _read_rows(path))
    gaussians = BoundGaussians(
        means=columns.stack("x", "y", "z"),
        quats=columns.stack(*(f"rot_{i}" for i in range(4))),
        log_scales=columns.stack(*(f"scale_{i}" for i in range(3))),
        opacity_logits=columns.stack("opacity")[:, 0],
        sh=_harmonics(columns),
        binding=_binding(columns, faces),
    )
    check_gaussians(path, {field: (name, getattr(gaussians, name)) for field, name in CHECKED.items()})
    return gaussians


class _Columns:
    """The properties of a file by name."""

    def __init__(self, path: Path, rows: np.ndarray) -> None:
        self.path, self.rows = path, rows

    def stack(self, *names: str) -> np.ndarray:
        """float32[N, len(names)], finite."""
        out = np.empty((len(self.rows), len(names)), np.float32)
        for i, name in enumerate(names):
            if name not in self.rows.dtype.names:
                raise DataError(self.path, name, expected="a property of vertex", found="nothing")
            with np.errstate(over="ignore"):
                out[:, i] = self.rows[name]
            if not np.isfinite(out[:, i]).all():
                raise DataError(self.path, name, expected="finite numbers", found="one that is not")
        return out


def _harmonics(columns: _Columns) -> np.ndarray:
    """float32[N, S, 3]; the file has all of red's higher ones first, then green's, then blue's."""
    rest = sum(name.startswith("f_rest_") for name in columns.rows.dtype.names)
    if rest % 3 or 1 + rest // 3 not in SH_COUNTS:
        expected = "0, 9, 24 or 45 properties (harmonics of degree 0 to 3)"
        raise DataError(columns.path, "f_rest_*", expected=expected, found=rest)
    first = columns.stack(*(f"f_dc_{i}" for i in range(3)))[:, None]
    higher = columns.stack(*(f"f_rest_{i}" for i in range(rest))).reshape(len(first), 3, rest // 3)
    return np.ascontiguousarray(np.concatenate([first, higher.swapaxes(1, 2)], 1))


def _binding(columns: _Columns, faces: int) -> np.ndarray:
    """int32[N]; the released code writes it as float32, which holds such numbers exactly."""
    found = columns.stack("binding_0")[:, 0]
    wrong = (found != np.round(found)) | (found < 0) | (found >= faces)
    if wrong.any():
        expected = f"whole numbers from 0 to {faces - 1}, the triangles"
        raise DataError(columns.path, "binding_0", expected=expected, found=found[np.argmax(wrong)])
    return found.astype(np.int32)


def _read_rows(path: Path) -> np.ndarray:
    """The table, one record a Gaussian."""
    try:
        with open(path, "rb") as file:
            count, dtype = _read_header(path, file)
            size = path.stat().st_size - file.tell()
            if size != count * dtype.itemsize:
                expected = f"{count * dtype.itemsize} bytes for {count} vertices"
                raise DataError(path, "data", expected=expected, found=f"{size} bytes")
            return np.fromfile(file, dtype, count)
    except OSError as error:
        raise DataError(path, "file", expected="a PLY file", found=error.strerror) from error


def _read_header(path: Path, file: BinaryIO) -> tuple[int, np.dtype]:
    """Number of vertices and what one is made of. The file is left at the first of them."""
    lines = _header_lines(path, file)
    for at, expected in enumerate(("ply", "format binary_little_endian 1.0")):
        found = lines[at] if at < len(lines) else "nothing"
        if found != expected:
            raise DataError(path, f"header line {at + 1}", expected=expected, found=repr(found[:64]))
    fields = [line.split() for line in lines[2:] if not line.startswith(("comment", "obj_info"))]
    low, high = COUNTS["gaussians"]
    element = fields[0] if fields else []
    number = element[2] if len(element) == 3 and element[:2] == ["element", "vertex"] else ""
    if not (number.isdecimal() and len(number) < 9 and low <= int(number) <= high):
        expected, found = f"`element vertex N`, N from {low} to {high}", repr(" ".join(element)[:64])
        raise DataError(path, "element", expected=expected, found=found)
    return int(number), _record(path, fields[1:])


def _header_lines(path: Path, file: BinaryIO) -> list[str]:
    lines = []
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES).decode("ascii", "backslashreplace").rstrip("\r\n")
        if line == "end_header":
            return lines
        lines.append(line)
        if not line:
            break
    expected = f"end_header within {MAX_HEADER_BYTES} bytes, no empty line"
    raise DataError(path, "header", expected=expected, found=f"{len(lines)} lines without")


def _record(path: Path, fields: list[list[str]]) -> np.dtype:
    properties = []
    for field in fields:
        if len(field) != 3 or field[0] != "property" or field[1] not in TYPES:
            found = repr(" ".join(field)[:64])
            raise DataError(path, "header", expected="scalar properties of vertex alone", found=found)
        properties.append((field[2], TYPES[field[1]]))
    names = [name for name, _ in properties]
    if not 0 < len(names) <= MAX_PROPERTIES or len(set(names)) != len(names):
        expected = f"1 to {MAX_PROPERTIES} properties, none twice"
        raise DataError(path, "header", expected=expected, found=f"{len(names)}, {len(set(names))} names")
    return np.dtype(properties)
