"""`.cap4d` file -> Bundle. Nothing in it is believed before it is checked, and nothing is ever run.

Order: container, manifest, then per entry size, hash and content. Every failure is a DataError of one
line that names `file:entry`, the field, what was expected and what was found.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import safetensors

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.container import Container
from cap4d.bundle.manifest import Manifest, digest
from cap4d.bundle.onnx_scan import scan_onnx
from cap4d.bundle.packing import unpack
from cap4d.bundle.png_header import check_png
from cap4d.bundle.quantized_unet import check_quantized
from cap4d.bundle.schema import (
    ENTRIES,
    GAUSSIANS,
    GRID,
    IDLE,
    INT8,
    MANIFEST,
    MAX_ENTRY_BYTES,
    ONNX,
    PREVIEW,
    RIG,
    check_relations,
    check_tensors,
)
from cap4d.drive.clip import Clip
from cap4d.errors import DataError
from cap4d.rig.grid import UvGrid, mesh_grid
from cap4d.rig.head import Subject

DTYPES = {
    **{"F32": np.float32, "F16": np.float16, "I8": np.int8, "I32": np.int32},
    **{"U8": np.uint8, "U16": np.uint16, "U32": np.uint32},
}


def read_bundle(path: str | Path) -> Bundle:
    """Reads a `.cap4d` file.

    Raises:
        DataError: See above.
    """
    path = Path(path)
    with Container(path, ENTRIES) as container:
        manifest = _read_manifest(container)
        tensors = {entry: _read_tensors(container, entry, manifest) for entry in (GRID, RIG, GAUSSIANS, IDLE)}
        check_relations(str(path), tensors)
        preview = _read_entry(container, PREVIEW, manifest)
        check_png(preview, source=f"{path}:{PREVIEW}")
        networks = _read_networks(container, manifest)
    return _assemble(manifest, tensors, networks, preview)


def read_manifest(path: str | Path) -> Manifest:
    """Reads only the manifest of a `.cap4d` file; the other entries are not opened."""
    with Container(Path(path), ENTRIES) as container:
        return _read_manifest(container)


def _read_manifest(container: Container) -> Manifest:
    where = f"{container.path}:{MANIFEST}"
    if MANIFEST not in container.spans:
        raise DataError(where, "entry", expected="a manifest", found="nothing")
    size, limit = container.spans[MANIFEST].size, MAX_ENTRY_BYTES[MANIFEST]
    if size > limit:
        raise DataError(where, "size", expected=f"at most {limit} bytes", found=size)
    data = container.read(MANIFEST)
    container.check_crc(MANIFEST, data)
    manifest = Manifest.from_json(data, source=str(container.path))
    present = set(container.spans) - {MANIFEST}
    for name in sorted(present ^ set(manifest.entries)):
        expected = "an entry of the zip" if name in manifest.entries else "only entries of the manifest"
        found = "nothing" if name in manifest.entries else "an entry it does not list"
        raise DataError(f"{container.path}:{name}", "entry", expected=expected, found=found)
    return manifest


def _read_entry(container: Container, name: str, manifest: Manifest) -> bytes:
    where, (size, sha256) = f"{container.path}:{name}", manifest.entries[name]
    if container.spans[name].size != size:
        raise DataError(where, "size", expected=f"{size} bytes", found=container.spans[name].size)
    data = container.read(name)
    found = digest(data)
    if found != sha256:
        raise DataError(where, "sha256", expected=sha256, found=found)
    return data


def _read_networks(
    container: Container, manifest: Manifest
) -> tuple[bytes | None, dict[str, np.ndarray] | None]:
    """The network as ONNX and in whole numbers, as far as they are there."""
    source, size = str(container.path), manifest.counts["grid_size"]
    network = quantized = None
    if ONNX in manifest.entries:
        network = _read_entry(container, ONNX, manifest)
        scan_onnx(network, source=f"{source}:{ONNX}", size=size)
    if INT8 in manifest.entries:
        quantized = _deserialize(container, INT8, manifest)
        check_quantized(quantized, source=f"{source}:{INT8}", size=size)
    return network, quantized


def _read_tensors(container: Container, entry: str, manifest: Manifest) -> dict[str, np.ndarray]:
    source, stored = str(container.path), _deserialize(container, entry, manifest)
    form = {"counts": manifest.counts, "precision": manifest.precision, "version": manifest.version}
    tensors = unpack(source, entry, stored, **form)
    check_tensors(source, entry, tensors, **form)
    return tensors


def _deserialize(container: Container, entry: str, manifest: Manifest) -> dict[str, np.ndarray]:
    """The tensors of an entry as they lie there, of any name and shape."""
    where = f"{container.path}:{entry}"
    try:
        items = safetensors.deserialize(_read_entry(container, entry, manifest))
    except safetensors.SafetensorError as error:
        raise DataError(where, "safetensors", expected="a safetensors file", found=error) from None
    tensors = {}
    for name, item in items:
        if item["dtype"] not in DTYPES:
            expected = f"a dtype of {', '.join(DTYPES)}"
            raise DataError(where, name[:64], expected=expected, found=item["dtype"])
        tensors[name] = np.frombuffer(item["data"], DTYPES[item["dtype"]]).reshape(item["shape"])
    return tensors


def _assemble(
    manifest: Manifest,
    tensors: dict[str, dict[str, np.ndarray]],
    networks: tuple[bytes | None, dict[str, np.ndarray] | None],
    preview: bytes,
) -> Bundle:
    grid, neutral = _grid(manifest, tensors[GRID])
    linear = tensors[GRID].get("deform_linear")
    names = {"rig_name": manifest.rig_name, "expression_names": manifest.expression_names}
    subject = Subject(**names, joint_drivers=manifest.joint_drivers, **_floats(tensors[RIG]))
    mesh = subject if manifest.rig_points == "mesh" else None
    gaussians = {name: value for name, value in tensors[GAUSSIANS].items() if name != "binding"}
    return Bundle(
        rig_licence=manifest.rig_licence,
        expression_range=manifest.expression_range,
        grid=grid,
        subject=subject if mesh is None or grid.is_mesh else mesh.resample(grid.vertices, grid.bary),
        deform_neutral=neutral,
        deform_onnx=networks[0],
        **_floats(gaussians),
        binding=tensors[GAUSSIANS]["binding"].astype(np.int32),
        camera=manifest.camera,
        idle=Clip(manifest.rig_name, manifest.idle_fps, **_floats(tensors[IDLE])),
        preview=preview,
        mesh_subject=mesh,
        deform_int8=networks[1],
        deform_linear=None if linear is None else linear.astype(np.float32),
        tier_errors=manifest.tier_errors,
        rig_vertices=manifest.counts["rig_vertices"],
    )


def _grid(manifest: Manifest, tensors: dict[str, np.ndarray]) -> tuple[UvGrid, np.ndarray]:
    """The surface, and float32[G, 3] m the network's answer to no offsets."""
    size, faces = manifest.counts["grid_size"], tensors["faces"].astype(np.int32)
    if size == 0:
        points = manifest.counts["grid_vertices"]
        return mesh_grid(faces, points), np.zeros((points, 3), np.float32)
    grid = UvGrid(
        size=size,
        pixels=tensors["pixels"].astype(np.int16),
        faces=faces,
        deformable=tensors["deformable"].astype(bool),
        vertices=tensors["vertices"].astype(np.int32),
        bary=tensors["bary"].astype(np.float32),
    )
    return grid, tensors["deform_neutral"].astype(np.float32)


def _floats(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Owned float32 arrays."""
    return {name: value.astype(np.float32) for name, value in tensors.items()}
