"""Sequences of mesh vertices on disk, as CodeTalker and VOCA write them on FLAME's topology."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.fit import MAX_FRAMES
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.npz import checked, read_npy, read_npz

VERTEX_FPS = 30.0  # CodeTalker on VOCASET; the files name no rate
FLAME_VERTICES = 5023
BIWI_VERTICES = 23370
MAX_TEMPLATE_BYTES = 64 << 20


def expected_vertices(bundle: Bundle) -> int:
    """Vertices of a frame for this avatar: FLAME's own for a FLAME rig (without CAP4D's mouth, fact 14)."""
    return FLAME_VERTICES if bundle.rig_name.startswith("flame") else bundle.rig_vertices


def read_vertices(path: Path, count: int | None) -> np.ndarray:
    """float32[T, count, 3] m from an .npy of [T, 3 count] or [T, count, 3]; None: of any count.

    Raises:
        DataError: Not sound, or of another topology.
    """
    value = _numbers(path, "vertices", read_npy(path))
    per_frame = value.shape[1] if value.ndim == 2 else value.shape[1] * 3 if value.ndim == 3 else 0
    if count is None:
        count = max(per_frame // 3, 1)
    if per_frame != 3 * count or (value.ndim == 3 and value.shape[2] != 3):
        other = " (BIWI's mesh, which is not FLAME's)" if per_frame == 3 * BIWI_VERTICES else ""
        expected = f"[T, {3 * count}] or [T, {count}, 3]"
        raise DataError(path, "vertices", expected=expected, found=f"{list(value.shape)}{other}")
    if not 1 <= len(value) <= MAX_FRAMES:
        raise DataError(path, "vertices", expected=f"1 to {MAX_FRAMES} frames", found=len(value))
    return value.reshape(len(value), count, 3)


def read_template(path: Path, count: int) -> np.ndarray:
    """float32[count, 3] m neutral: an .npy, an .npz with key `template`, or the `v` lines of an .obj.

    Raises:
        ArgumentError: Another kind of file.
        DataError: Not sound, or of another topology.
    """
    readers = {".npy": read_npy, ".npz": _read_template_npz, ".obj": _read_obj}
    if path.suffix not in readers:
        raise ArgumentError(f"template: expected one of {', '.join(readers)}, got {path}")
    value = readers[path.suffix](path)
    if value is not None and value.shape == (3 * count,):
        value = value.reshape(count, 3)
    checked(path, "template", value, kind="float", shape=(count, 3))
    return _numbers(path, "template", value)


def _numbers(path: Path, name: str, value: np.ndarray) -> np.ndarray:
    if value.dtype.kind != "f":
        raise DataError(path, name, expected="floating-point numbers, m", found=value.dtype)
    with np.errstate(over="ignore"):
        value = np.ascontiguousarray(value, np.float32)
    if value.size and not np.isfinite([value.min(), value.max()]).all():
        raise DataError(path, name, expected="finite numbers", found="one that is not")
    return value


def _read_template_npz(path: Path) -> np.ndarray | None:
    return read_npz(path, names={"template"}).get("template")


def _read_obj(path: Path) -> np.ndarray:
    try:
        if path.stat().st_size > MAX_TEMPLATE_BYTES:
            raise DataError(
                path, "size", expected=f"at most {MAX_TEMPLATE_BYTES} bytes", found=path.stat().st_size
            )
        lines = path.read_text("ascii", errors="replace").splitlines()
        rows = [[float(word) for word in line.split()[1:4]] for line in lines if line.startswith("v ")]
        return np.array(rows, np.float32).reshape(len(rows), 3)
    except (OSError, ValueError) as error:
        raise DataError(path, "v", expected="lines of three numbers", found=error) from error
