"""Bundle -> `.cap4d` file. The same bundle gives the same bytes; a failed write leaves nothing behind."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from safetensors.numpy import save as save_tensors

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.container import write_container
from cap4d.bundle.manifest import Manifest, digest
from cap4d.bundle.onnx_scan import scan_onnx
from cap4d.bundle.png_header import check_png
from cap4d.bundle.schema import (
    GAUSSIANS,
    GRID,
    IDLE,
    MANIFEST,
    ONNX,
    PREVIEW,
    RIG,
    TENSORS,
    check_relations,
    check_tensors,
    stored_dtype,
)
from cap4d.errors import ArgumentError
from cap4d.rig.head import Subject

SUBJECT_ARRAYS = (
    *("neutral", "expression_basis", "joints", "joints_expression"),
    *("skin_weights", "expr_rotation", "pose_basis", "pose_offset"),
)


def write_bundle(
    bundle: Bundle, path: str | Path, *, precision: Literal["float32", "float16"] = "float32"
) -> None:
    """Writes `bundle` to `path`, through a temporary file.

    Args:
        precision: `float16` halves the file: Gaussians, blendshapes and the deformer's weights are rounded
            (this form needs the `onnx` package; playing it does not).
    Raises:
        DataError: The bundle breaks a rule of FORMAT.md: whatever is written can be read.
        ArgumentError: The folder is not there, or `subject` is not the mixture of `mesh_subject`.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise ArgumentError(f"{path}: its folder does not exist")
    counts, subject = bundle_counts(bundle), stored_subject(bundle)
    tensors = {
        GRID: _grid_tensors(bundle),
        RIG: {name: getattr(subject, name) for name in SUBJECT_ARRAYS if getattr(subject, name) is not None},
        GAUSSIANS: {name: getattr(bundle, name) for name in TENSORS[GAUSSIANS]},
        IDLE: {
            name: getattr(bundle.idle, name)
            for name in TENSORS[IDLE]
            if getattr(bundle.idle, name) is not None
        },
    }
    stored = {entry: _as_stored(entry, arrays, counts, precision) for entry, arrays in tensors.items()}
    for entry, arrays in stored.items():
        check_tensors(str(path), entry, arrays, counts=counts, precision=precision)
    check_relations(str(path), stored)
    entries = {entry: save_tensors(arrays) for entry, arrays in stored.items()}
    entries[PREVIEW] = bundle.preview
    check_png(bundle.preview, source=f"{path}:{PREVIEW}")
    if bundle.deform_onnx is not None:
        entries[ONNX] = _network(bundle.deform_onnx, precision)
        scan_onnx(entries[ONNX], source=f"{path}:{ONNX}", size=bundle.grid.size)
    manifest = _manifest(bundle, counts, precision, entries)
    Manifest.from_json(manifest, source=str(path))
    write_container(path, {MANIFEST: manifest} | dict(sorted(entries.items())))


def bundle_counts(bundle: Bundle) -> dict[str, int]:
    """The manifest's counts."""
    return {
        "grid_size": bundle.grid.size,
        "grid_vertices": len(bundle.grid.pixels),
        "faces": len(bundle.grid.faces),
        "gaussians": len(bundle.means),
        "sh_coefficients": bundle.sh.shape[1],
        "expressions": len(bundle.subject.expression_names),
        "joints": len(bundle.subject.joint_drivers),
        "rig_points": len(stored_subject(bundle).neutral),
        "rig_vertices": bundle.rig_vertices,
        "idle_frames": len(bundle.idle),
    }


def stored_subject(bundle: Bundle) -> Subject:
    """The subject that goes into the file: on the rig's vertices where those are fewer than the grid's."""
    mesh = bundle.mesh_subject
    return mesh if mesh is not None and len(mesh.neutral) < len(bundle.subject.neutral) else bundle.subject


def _manifest(bundle: Bundle, counts: dict[str, int], precision: str, entries: dict[str, bytes]) -> bytes:
    on_mesh = stored_subject(bundle) is not bundle.subject
    if on_mesh:
        _check_mixture(bundle)
    if np.shape(bundle.expression_range) != (counts["expressions"], 2):
        found = np.shape(bundle.expression_range)
        raise ArgumentError(f"expression_range: expected [{counts['expressions']}, 2], got {found}")
    if bundle.idle.rig_name != bundle.rig_name:
        raise ArgumentError(
            f"idle: expected a clip for {bundle.rig_name}, got one for {bundle.idle.rig_name}"
        )
    return Manifest(
        precision=precision,
        rig_name=bundle.rig_name,
        rig_licence=bundle.rig_licence,
        rig_points="mesh" if on_mesh else "grid",
        joint_drivers=bundle.subject.joint_drivers,
        expression_names=bundle.subject.expression_names,
        expression_range=bundle.expression_range,
        counts=counts,
        camera=bundle.camera,
        idle_fps=float(bundle.idle.fps),
        entries={name: (len(data), digest(data)) for name, data in entries.items()},
    ).to_json()


def _check_mixture(bundle: Bundle) -> None:
    mixed = bundle.mesh_subject.resample(bundle.grid.vertices, bundle.grid.bary)
    for name in SUBJECT_ARRAYS:
        pair = getattr(mixed, name), getattr(bundle.subject, name)
        if not (pair[0] is pair[1] is None or np.array_equal(*pair)):
            raise ArgumentError(f"subject.{name}: expected the mixture of mesh_subject's, got another")


def _grid_tensors(bundle: Bundle) -> dict[str, np.ndarray]:
    grid = bundle.grid
    return {
        "pixels": grid.pixels,
        "faces": grid.faces,
        "deformable": grid.deformable,
        "vertices": grid.vertices,
        "bary": grid.bary,
        "deform_neutral": bundle.deform_neutral,
    }


def _as_stored(
    entry: str, arrays: dict[str, np.ndarray], counts: dict[str, int], precision: str
) -> dict[str, np.ndarray]:
    """The arrays in the file's dtypes. Indices that a dtype cannot hold stay, for the checks to name."""
    stored = {}
    for name, array in arrays.items():
        dtype = stored_dtype(TENSORS[entry][name], counts, precision)
        with np.errstate(over="ignore", invalid="ignore"):
            cast = np.ascontiguousarray(array, dtype)
        lossless = dtype.kind == "f" or np.array_equal(cast, array)
        stored[name] = cast if lossless else np.asarray(array)
    return stored


def _network(model: bytes, precision: str) -> bytes:
    if precision == "float32":
        return model
    from cap4d.bundle.onnx_half import halve_weights

    return halve_weights(model)
