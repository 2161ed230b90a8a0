"""What a `.cap4d` file may hold: entries, tensors, counts and limits, as tables. FORMAT.md is the prose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cap4d.errors import DataError

FORMAT, VERSION = "cap4d", 3
PRECISIONS = ("float32", "float16", "mixed")
"""`mixed`: every packed tensor is float32, float16 or int8, as its own dtype says."""
TIERS = ("full", "fp16", "int8", "linear", "off")
"""Ways to answer an expression with a deformation, from the dearest to the cheapest."""
AXES, UNITS, RIG_AXES = "opencv", "metre", "y_up"

MANIFEST, GRID, RIG = "manifest.json", "tensors/grid.safetensors", "tensors/rig.safetensors"
GAUSSIANS, IDLE = "tensors/gaussians.safetensors", "idle.safetensors"
ONNX, INT8, PREVIEW = "deform.onnx", "tensors/deform_int8.safetensors", "preview.png"
REQUIRED_ENTRIES = (GAUSSIANS, GRID, IDLE, PREVIEW, RIG)
OPTIONAL_ENTRIES = (ONNX, INT8)
ENTRIES = (MANIFEST, *REQUIRED_ENTRIES, *OPTIONAL_ENTRIES)
MAX_ENTRY_BYTES = {
    MANIFEST: 1 << 20,
    PREVIEW: 16 << 20,
    **dict.fromkeys((GRID, RIG, GAUSSIANS, IDLE, ONNX, INT8), 512 << 20),
}

COUNTS = {
    "grid_size": (0, 1024),  # 0: no grid, the rig's own triangles; otherwise at least MIN_GRID_SIZE
    "grid_vertices": (3, 1 << 20),
    "faces": (1, 1 << 21),
    "gaussians": (1, 1 << 22),
    "sh_coefficients": (1, 16),
    "expressions": (1, 1024),
    "joints": (0, 64),
    "rig_points": (3, 1 << 20),
    "rig_vertices": (1, 1 << 22),
    "idle_frames": (1, 100_000),
}
"""Inclusive limits of every count in the manifest."""
MIN_GRID_SIZE = 8
MAX_GRID_VALUES = MAX_ENTRY_BYTES[RIG] // 4
"""Of a basis on the grid's vertices, [E, G, 3] or [9J, G, 3]: no more than its entry holds in float32."""

SYMBOLS = {
    "S": "grid_size",
    "G": "grid_vertices",
    "M": "faces",
    "N": "gaussians",
    "C": "sh_coefficients",
    "E": "expressions",
    "J": "joints",
    "P": "rig_points",
    "V": "rig_vertices",
    "T": "idle_frames",
}

Kind = Literal["float", "packed", "index", "flag"]
Steps = Literal["row", "column"]


@dataclass(frozen=True)
class TensorSpec:
    """One tensor of one entry.

    Args:
        shape: Sizes: a number, or a symbol of `SYMBOLS`, or `9J`.
        kind: `float` is float32; `packed` is as the file's precision says (see packing.py); `index` is the
            smaller of uint16 and uint32 that holds indices `below`; `flag` is uint8, 0 or 1.
        low, high: Inclusive limits of float values.
        below: Symbol of the count that indices stay under.
        steps: Whether each `row` (first index) or each `column` (the other indices) has its own step where
            the tensor is int8. Those of rows may be masked.
        since: The first version of the format that has it.
        of_grid: Only a UV grid has it: not there where `grid_size` is 0.
    """

    shape: tuple[int | str, ...]
    kind: Kind = "float"
    low: float = -1e4
    high: float = 1e4
    below: str | None = None
    optional: bool = False
    steps: Steps = "column"
    since: int = 1
    of_grid: bool = False


METRES = {"low": -10.0, "high": 10.0}  # a head is 0.3 m: catches millimetres and rubbish alike
RADIANS = {"low": -100.0, "high": 100.0}

TENSORS: dict[str, dict[str, TensorSpec]] = {
    GRID: {
        "pixels": TensorSpec(("G", 2), "index", below="S", of_grid=True),
        "faces": TensorSpec(("M", 3), "index", below="G"),
        "deformable": TensorSpec(("G",), "flag", of_grid=True),
        "vertices": TensorSpec(("G", 3), "index", below="V", of_grid=True),
        "bary": TensorSpec(("G", 3), low=-0.01, high=1.01, of_grid=True),
        "deform_neutral": TensorSpec(("G", 3), **METRES, of_grid=True),
        "deform_linear": TensorSpec(
            ("E", "G", 3), "packed", **METRES, optional=True, steps="row", since=2, of_grid=True
        ),
    },
    RIG: {
        "neutral": TensorSpec(("P", 3), **METRES),
        "expression_basis": TensorSpec(("E", "P", 3), "packed", **METRES, steps="row"),
        "joints": TensorSpec(("J", 3), **METRES),
        "joints_expression": TensorSpec(("E", "J", 3), **METRES),
        "skin_weights": TensorSpec(("P", "J"), low=-1e-3, high=1.001),
        "expr_rotation": TensorSpec(("E", 3), **RADIANS, optional=True),
        "pose_basis": TensorSpec(("9J", "P", 3), "packed", **METRES, optional=True, steps="row"),
        "pose_offset": TensorSpec(("P", 3), **METRES, optional=True),
    },
    GAUSSIANS: {
        "means": TensorSpec(("N", 3), "packed"),
        "quats": TensorSpec(("N", 4), "packed"),
        "log_scales": TensorSpec(("N", 3), "packed", low=-60, high=20),
        "opacity_logits": TensorSpec(("N",), "packed"),
        "sh": TensorSpec(("N", "C", 3), "packed"),
        "binding": TensorSpec(("N",), "index", below="M"),
    },
    IDLE: {
        "expr": TensorSpec(("T", "E"), low=-100, high=100),
        "eye_rot": TensorSpec(("T", 3), **RADIANS),
        "neck_rot": TensorSpec(("T", 3), **RADIANS),
        "jaw_rot": TensorSpec(("T", 3), **RADIANS),
        "rot": TensorSpec(("T", 3), **RADIANS, optional=True),
        "tra": TensorSpec(("T", 3), low=-1000, high=1000, optional=True),
    },
}


def stored_dtype(spec: TensorSpec, counts: Mapping[str, int], precision: str = "float32") -> np.dtype:
    """The dtype that a tensor has in the file; of a packed one, what `float32` or `float16` makes it."""
    if spec.kind == "flag":
        return np.dtype(np.uint8)
    if spec.kind == "index":
        return np.dtype(np.uint16 if counts[SYMBOLS[spec.below]] <= 1 << 16 else np.uint32)
    return np.dtype(np.float16 if spec.kind == "packed" and precision == "float16" else np.float32)


def stored_dtypes(spec: TensorSpec, counts: Mapping[str, int], precision: str) -> tuple[np.dtype, ...]:
    """The dtypes that a tensor may have in the file, or, of an int8 one, once it is unpacked."""
    if spec.kind == "packed" and precision == "mixed":
        return np.dtype(np.float32), np.dtype(np.float16)
    return (stored_dtype(spec, counts, precision),)


def stored_shape(spec: TensorSpec, counts: Mapping[str, int]) -> tuple[int, ...]:
    """The shape that a tensor has in a file with these counts."""
    sizes = {symbol: counts[name] for symbol, name in SYMBOLS.items()}
    sizes["9J"] = 9 * sizes["J"]
    return tuple(size if isinstance(size, int) else sizes[size] for size in spec.shape)


def check_tensors(
    source: str,
    entry: str,
    tensors: Mapping[str, np.ndarray],
    *,
    counts: Mapping[str, int],
    precision: str,
    version: int = VERSION,
) -> None:
    """Checks an entry's tensors against the tables: names, dtypes, shapes, limits, finiteness.

    Args:
        tensors: As stored, except that int8 and masked ones are unpacked.
    Raises:
        DataError: Naming `source:entry`, the tensor, what was expected and what was found.
    """
    where = f"{source}:{entry}"
    has_grid = counts["grid_size"] > 0
    specs = {
        name: spec
        for name, spec in TENSORS[entry].items()
        if spec.since <= version and (has_grid or not spec.of_grid)
    }
    for name in tensors:
        if name not in specs:
            raise DataError(where, "tensors", expected=f"only {', '.join(specs)}", found=repr(name[:64]))
    for name, spec in specs.items():
        if name in tensors:
            _check_tensor(where, name, tensors[name], spec, counts, precision)
        elif not spec.optional:
            raise DataError(where, name, expected="a tensor", found="nothing")


def _check_tensor(
    where: str, name: str, value: np.ndarray, spec: TensorSpec, counts: Mapping[str, int], precision: str
) -> None:
    dtypes, shape = stored_dtypes(spec, counts, precision), stored_shape(spec, counts)
    if value.dtype not in dtypes or value.shape != shape:
        expected = f"{' or '.join(map(str, dtypes))}{list(shape)}"
        raise DataError(where, name, expected=expected, found=f"{value.dtype}{list(value.shape)}")
    if not value.size:
        return
    low, high = value.min(), value.max()
    if spec.kind in ("float", "packed"):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise DataError(where, name, expected="finite numbers", found="a value that is not finite")
        if low < spec.low or high > spec.high:
            worst = low if low < spec.low else high
            raise DataError(where, name, expected=f"numbers in [{spec.low:g}, {spec.high:g}]", found=worst)
    else:
        limit = 2 if spec.kind == "flag" else counts[SYMBOLS[spec.below]]
        if high >= limit:
            raise DataError(where, name, expected=f"indices below {limit}", found=high)


def check_relations(source: str, tensors: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Checks what no single tensor shows: order, duplicates, sums, norms. Call after `check_tensors`.

    Raises:
        DataError: As above.
    """
    grid, rig, gaussians, idle = (tensors[entry] for entry in (GRID, RIG, GAUSSIANS, IDLE))
    if "pixels" in grid:
        _check_scan_order(f"{source}:{GRID}", grid["pixels"].astype(np.int64))
        _check_sums(f"{source}:{GRID}", "bary", grid["bary"], 1 - 1e-3, 1 + 1e-3)
    faces = grid["faces"]
    repeated = (faces == np.roll(faces, 1, axis=1)).any(1)
    if repeated.any():
        found = faces[np.argmax(repeated)].tolist()
        raise DataError(f"{source}:{GRID}", "faces", expected="three different vertices", found=found)
    if "deform_linear" in grid and grid["deform_linear"][:, grid["deformable"] == 0].any():
        expected, found = "0 where the grid is not deformable", "another number"
        raise DataError(f"{source}:{GRID}", "deform_linear", expected=expected, found=found)
    _check_sums(f"{source}:{RIG}", "skin_weights", rig["skin_weights"], -1e-3, 1 + 1e-3)
    quats = gaussians["quats"].astype(np.float32)
    norm2 = (quats * quats).sum(1)
    if norm2.min() < 1e-12:
        found = f"quats[{int(np.argmin(norm2))}] of norm {np.sqrt(norm2.min()):g}"
        raise DataError(f"{source}:{GAUSSIANS}", "quats", expected="norms of at least 1e-6", found=found)
    if ("rot" in idle) != ("tra" in idle):
        raise DataError(f"{source}:{IDLE}", "rot, tra", expected="both or neither", found="one of them")


def _check_scan_order(where: str, pixels: np.ndarray) -> None:
    scan = pixels[:, 0] * (1 << 16) + pixels[:, 1]
    at = int(np.argmin(np.diff(scan))) if len(scan) > 1 else 0
    if len(scan) > 1 and scan[at + 1] <= scan[at]:
        found = f"{pixels[at + 1].tolist()} after {pixels[at].tolist()}"
        raise DataError(where, "pixels", expected="each pixel once, in scan order", found=found)


def _check_sums(where: str, name: str, values: np.ndarray, low: float, high: float) -> None:
    sums = values.sum(1)
    if len(sums) and not (low <= sums.min() and sums.max() <= high):
        worst = sums.min() if sums.min() < low else sums.max()
        raise DataError(where, name, expected=f"rows that sum to [{low:g}, {high:g}]", found=worst)
