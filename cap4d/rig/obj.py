"""Wavefront OBJ as head models use it: vertices, texture vertices, triangles, quads. The rest is skipped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.errors import DataError
from cap4d.rig.npz import checked, checked_indices

MAX_BYTES = 1 << 28


@dataclass(frozen=True, eq=False)
class ObjMesh:
    """float64 `vertices` [V, 3] and `uvs` [T, 2]; int32 `faces` and `uv_faces` [F, 4], -1 in column 3 of a
    triangle.
    """

    vertices: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    uv_faces: np.ndarray


def read_obj(path: Path) -> ObjMesh:
    """Reads vertices, texture vertices and faces (`v/vt` or `v/vt/vn` corners, triangles or quads).

    Raises:
        DataError: Unreadable, not numbers, an index out of range, a face without texture vertices.
    """
    lines = _lines(path)
    vertices = _numbers(path, "v", lines, 3)
    uvs = _numbers(path, "vt", lines, 2)
    corners = _corners(path, [line for line in lines if line.startswith(b"f ")])
    shape = (None, 4)
    faces = checked_indices(path, "f", corners[..., 0] + 1, shape=shape, below=len(vertices) + 1) - 1
    uv_faces = checked_indices(path, "f (texture)", corners[..., 1] + 1, shape=shape, below=len(uvs) + 1) - 1
    return ObjMesh(vertices, uvs, faces, uv_faces)


def read_obj_vertices(path: Path) -> np.ndarray:
    """float64[V, 3] the vertices alone."""
    return _numbers(path, "v", _lines(path), 3)


def triangulate(quads: np.ndarray, uv_quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[F, 4] quads with -1 in column 3 of triangles -> int32[N, 3] triangles (a, b, c), (a, c, d) and their
    UV ones.
    """
    is_quad = np.repeat(quads[:, 3] >= 0, 2)
    is_quad[::2] = True
    halves = [0, 1, 2], [0, 2, 3]
    both = (np.stack([q[:, half] for half in halves], 1).reshape(-1, 3) for q in (quads, uv_quads))
    return tuple(np.ascontiguousarray(triangles[is_quad], np.int32) for triangles in both)


def _lines(path: Path) -> list[bytes]:
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(path, "size", expected=f"at most {MAX_BYTES} bytes", found=path.stat().st_size)
        return path.read_bytes().split(b"\n")
    except OSError as error:
        raise DataError(path, "file", expected="a readable .obj", found=error.strerror) from error


def _numbers(path: Path, keyword: str, lines: list[bytes], count: int) -> np.ndarray:
    start = keyword.encode() + b" "
    rows = [line.split(None, count + 1)[1 : count + 1] for line in lines if line.startswith(start)]
    if not rows:
        raise DataError(path, keyword, expected=f"{count} numbers a line", found="no such line")
    try:
        values = np.array(rows, dtype=np.bytes_).astype(np.float64)
    except ValueError as error:
        raise DataError(path, keyword, expected=f"{count} numbers a line", found=error) from error
    return checked(path, keyword, values.reshape(len(rows), -1), kind="float", shape=(None, count))


def _corners(path: Path, lines: list[bytes]) -> np.ndarray:
    """int64[F, 4, 2] zero-based vertex and texture ids, -1 where a triangle has no fourth corner."""
    corners = np.full((len(lines), 4, 2), -1, np.int64)
    for row, line in enumerate(lines):
        tokens = line.split()[1:]
        try:
            pairs = [(int(a) - 1, int(b) - 1) for a, b in (token.split(b"/")[:2] for token in tokens)]
        except ValueError as error:
            raise DataError(
                path, "f", expected="corners v/vt", found=line.decode("ascii", "replace")
            ) from error
        if not 3 <= len(pairs) <= 4 or min(min(pair) for pair in pairs) < 0:
            raise DataError(path, "f", expected="3 or 4 corners", found=line.decode("ascii", "replace"))
        corners[row, : len(pairs)] = pairs
    return corners
