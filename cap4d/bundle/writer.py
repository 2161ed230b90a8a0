"""Bundle -> `.cap4d` file. The same bundle gives the same bytes; a failed write leaves nothing behind."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from safetensors.numpy import save as save_tensors

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.container import write_container
from cap4d.bundle.manifest import Manifest, digest
from cap4d.bundle.onnx_scan import scan_onnx
from cap4d.bundle.packing import FORMS, Form, pack, unpack
from cap4d.bundle.png_header import check_png
from cap4d.bundle.quantized_unet import check_quantized
from cap4d.bundle.schema import (
    GAUSSIANS,
    GRID,
    IDLE,
    INT8,
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


PACKED = tuple(name for specs in TENSORS.values() for name, spec in specs.items() if spec.kind == "packed")
Precision = Literal["float32", "float16"] | Mapping[str, Form]


def write_bundle(bundle: Bundle, path: str | Path, *, precision: Precision = "float32") -> None:
    """Writes `bundle` to `path`, through a temporary file.

    Args:
        precision: `float16` halves the file: Gaussians, blendshapes and the deformer's weights are rounded
            (this form needs the `onnx` package; playing it does not). Or a form for each of `PACKED`, and
            float32 or float16 for `deform.onnx`; what is not named is float32.
    Raises:
        DataError: The bundle breaks a rule of FORMAT.md: whatever is written can be read.
        ArgumentError: The folder is not there, `subject` is not the mixture of `mesh_subject`, or there is a
            deformation on the rig's own triangles.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise ArgumentError(f"{path}: its folder does not exist")
    write_container(path, bundle_entries(bundle, precision=precision, source=str(path)))


def bundle_entries(
    bundle: Bundle, *, precision: Precision = "float32", source: str = "bundle"
) -> dict[str, bytes]:
    """The entries that `write_bundle` writes, by name, the manifest first. See there.

    Args:
        source: For error messages.
    """
    forms = _forms(precision)
    name = precision if isinstance(precision, str) else "mixed"
    version = _version(bundle, name)
    if bundle.grid.is_mesh:
        _check_own_triangles(bundle)
    entries = _tensor_entries(bundle, source, forms, precision=name, version=version)
    entries[PREVIEW] = bundle.preview
    check_png(bundle.preview, source=f"{source}:{PREVIEW}")
    if bundle.deform_onnx is not None:
        entries[ONNX] = _network(bundle.deform_onnx, forms[ONNX])
        scan_onnx(entries[ONNX], source=f"{source}:{ONNX}", size=bundle.grid.size)
    if bundle.deform_int8 is not None:
        check_quantized(bundle.deform_int8, source=f"{source}:{INT8}", size=bundle.grid.size)
        quantized = {name: np.ascontiguousarray(value) for name, value in bundle.deform_int8.items()}
        entries[INT8] = save_tensors(quantized)
    manifest = _manifest(bundle, entries, precision=name, version=version)
    Manifest.from_json(manifest, source=source)
    return {MANIFEST: manifest} | dict(sorted(entries.items()))


def _forms(precision: Precision) -> dict[str, Form]:
    """The form of each packed tensor and of the network."""
    if isinstance(precision, str):
        precision = dict.fromkeys((*PACKED, ONNX), precision)
    for name, form in precision.items():
        forms = FORMS[:2] if name == ONNX else FORMS
        if name not in (*PACKED, ONNX) or form not in forms:
            raise ArgumentError(f"precision: expected {', '.join(forms)} of a tensor, got {name}: {form}")
    return dict.fromkeys((*PACKED, ONNX), "float32") | dict(precision)


def _version(bundle: Bundle, precision: str) -> int:
    """The lowest that knows all that the bundle has."""
    if bundle.grid.is_mesh:
        return 3
    tiers = bundle.deform_int8 is not None or bundle.deform_linear is not None or bool(bundle.tier_errors)
    return 2 if precision == "mixed" or tiers else 1


def _tensor_entries(
    bundle: Bundle, source: str, forms: Mapping[str, Form], *, precision: str, version: int
) -> dict[str, bytes]:
    counts, subject = bundle_counts(bundle), stored_subject(bundle)
    arrays = {
        GRID: _grid_tensors(bundle),
        RIG: {name: getattr(subject, name) for name in SUBJECT_ARRAYS},
        GAUSSIANS: {name: getattr(bundle, name) for name in TENSORS[GAUSSIANS]},
        IDLE: {name: getattr(bundle.idle, name) for name in TENSORS[IDLE]},
    }
    check = {"counts": counts, "precision": precision, "version": version}
    tensors, entries = {}, {}
    for entry, values in arrays.items():
        present = {name: value for name, value in values.items() if value is not None}
        stored = _as_stored(entry, present, counts, forms, version)
        tensors[entry] = unpack(source, entry, stored, **check)
        check_tensors(source, entry, tensors[entry], **check)
        entries[entry] = save_tensors(stored)
    check_relations(source, tensors)
    return entries


def bundle_counts(bundle: Bundle) -> dict[str, int]:
    """The manifest's counts."""
    return {
        "grid_size": bundle.grid.size,
        "grid_vertices": len(bundle.grid),
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
    """The subject that goes into the file: on the rig's vertices where those are fewer than the grid's.

    Of the rig's own triangles, `subject` stands on the rig's vertices itself.
    """
    mesh = bundle.mesh_subject
    return mesh if mesh is not None and len(mesh.neutral) < len(bundle.subject.neutral) else bundle.subject


def _manifest(bundle: Bundle, entries: dict[str, bytes], *, precision: str, version: int) -> bytes:
    counts = bundle_counts(bundle)
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
        version=version,
        precision=precision,
        rig_name=bundle.rig_name,
        rig_licence=bundle.rig_licence,
        rig_points="mesh" if on_mesh or bundle.grid.is_mesh else "grid",
        joint_drivers=bundle.subject.joint_drivers,
        expression_names=bundle.subject.expression_names,
        expression_range=bundle.expression_range,
        counts=counts,
        camera=bundle.camera,
        idle_fps=float(bundle.idle.fps),
        entries={name: (len(data), digest(data)) for name, data in entries.items()},
        tier_errors=bundle.tier_errors,
    ).to_json()


def _check_mixture(bundle: Bundle) -> None:
    mixed = bundle.mesh_subject.resample(bundle.grid.vertices, bundle.grid.bary)
    for name in SUBJECT_ARRAYS:
        pair = getattr(mixed, name), getattr(bundle.subject, name)
        if not (pair[0] is pair[1] is None or np.array_equal(*pair)):
            raise ArgumentError(f"subject.{name}: expected the mixture of mesh_subject's, got another")


def _check_own_triangles(bundle: Bundle) -> None:
    for name in ("deform_onnx", "deform_int8", "deform_linear"):
        if getattr(bundle, name) is not None:
            raise ArgumentError(f"{name}: expected none on the rig's own triangles, got one")
    for name, found in (("deform_neutral", bundle.deform_neutral.any()), ("tier_errors", bundle.tier_errors)):
        if found:
            raise ArgumentError(f"{name}: expected nothing on the rig's own triangles, got something")


def _grid_tensors(bundle: Bundle) -> dict[str, np.ndarray | None]:
    grid = bundle.grid
    if grid.is_mesh:
        return {"faces": grid.faces}
    return {
        "pixels": grid.pixels,
        "faces": grid.faces,
        "deformable": grid.deformable,
        "vertices": grid.vertices,
        "bary": grid.bary,
        "deform_neutral": bundle.deform_neutral,
        "deform_linear": bundle.deform_linear,
    }


def _as_stored(
    entry: str,
    arrays: dict[str, np.ndarray],
    counts: dict[str, int],
    forms: Mapping[str, Form],
    version: int,
) -> dict[str, np.ndarray]:
    """The arrays as the file has them. Indices that a dtype cannot hold stay, for the checks to name."""
    stored = {}
    for name, array in arrays.items():
        spec = TENSORS[entry][name]
        if spec.kind == "packed" and version >= 2:
            stored |= pack(name, array, spec, forms[name])
            continue
        dtype = np.dtype(forms[name]) if spec.kind == "packed" else stored_dtype(spec, counts)
        with np.errstate(over="ignore", invalid="ignore"):
            cast = np.ascontiguousarray(array, dtype)
        lossless = dtype.kind == "f" or np.array_equal(cast, array)
        stored[name] = cast if lossless else np.asarray(array)
    return stored


def _network(model: bytes, form: Form) -> bytes:
    if form == "float32":
        return model
    from cap4d.bundle.onnx_half import halve_weights

    return halve_weights(model)
