"""One malformed bundle per rule of FORMAT.md, each refused in one line: file, field, expected, found."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load

pytest.importorskip("onnx")

import onnx
from bundle_forge import Forge
from quantized_reference import random_network
from tiny_bundle import tiny_bundle, tiny_bundle_on_mesh

from cap4d.bundle import Bundle, read_bundle, write_bundle
from cap4d.bundle.container import CENTRAL_MAGIC, LOCAL_MAGIC
from cap4d.bundle.onnx_scan import scan_onnx
from cap4d.bundle.schema import GAUSSIANS, GRID, IDLE, INT8, MANIFEST, ONNX, PREVIEW, RIG
from cap4d.bundle.writer import PACKED
from cap4d.errors import DataError

SIZE = 8


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("hostile") / "sound.cap4d"
    write_bundle(tiny_bundle(SIZE, gaussians=1), path)
    return path


def refusal(path: Path) -> DataError:
    """The error that reading `path` ends with, checked for its form."""
    with pytest.raises(DataError) as caught:
        read_bundle(path)
    line = str(caught.value)
    assert "\n" not in line and len(line) < 1000
    assert line.startswith(str(path)) and ": expected " in line and ", found " in line
    return caught.value


# The archive ------------------------------------------------------------


def repack(**options) -> Callable[[Forge, Path], None]:
    def write(forge: Forge, path: Path) -> None:
        with zipfile.ZipFile(path, "w", **options) as archive:
            for name, data in forge.all_entries().items():
                archive.writestr(name, data)

    return write


def extra_entry(name: str) -> Callable[[Forge, Path], None]:
    def write(forge: Forge, path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            for entry, data in [*forge.all_entries().items(), (name, b"x")]:
                archive.writestr(zipfile.ZipInfo(entry), data)

    return write


def patched(change: Callable[[bytes], bytes]) -> Callable[[Forge, Path], None]:
    def write(forge: Forge, path: Path) -> None:
        forge.write(path)
        path.write_bytes(change(path.read_bytes()))

    return write


def poke(magic: bytes, offset: int, value: bytes, *, nth: int = 0) -> Callable[[bytes], bytes]:
    """Overwrites bytes of the nth record that begins with `magic`."""

    def change(data: bytes) -> bytes:
        at = -1
        for _ in range(nth + 1):
            at = data.index(magic, at + 1)
        return data[: at + offset] + value + data[at + offset + len(value) :]

    return change


def twice(data: bytes) -> bytes:
    """Names the preview as the manifest does the idle clip, in both places."""
    return data.replace(b"preview.png", b"deform.onnx")


def overlapping(data: bytes) -> bytes:
    """Lets the second entry be the first one's bytes, by name, size and offset of its directory record."""
    first = data.index(CENTRAL_MAGIC)
    name_length = struct.unpack_from("<H", data, first + 28)[0]
    second = first + 46 + name_length
    record = bytearray(data[second : second + 46])
    size = len(data[: data.index(CENTRAL_MAGIC)])
    local = data.index(LOCAL_MAGIC, 4)
    grown = struct.pack("<II", size - local - 200, size - local - 200)
    record[20:28] = grown
    changed = bytearray(data)
    changed[second : second + 46] = record
    changed[local + 18 : local + 26] = grown
    return bytes(changed)


ARCHIVES = {
    "empty": (lambda f, p: p.write_bytes(b""), "zip end record"),
    "not_a_zip": (lambda f, p: p.write_bytes(b"hello " * 100), "zip end record"),
    "missing_file": (lambda f, p: None, "file"),
    "a_folder": (lambda f, p: p.mkdir(), "file"),
    "cut_in_the_directory": (patched(lambda d: d[:-40]), "zip end record"),
    "cut_in_half": (patched(lambda d: d[: len(d) // 2]), "zip end record"),
    "cut_at_the_front": (patched(lambda d: d[100:]), "zip directory"),
    "something_appended": (patched(lambda d: d + b"\0"), "zip end record"),
    "something_prepended": (patched(lambda d: b"\0" + d), "zip directory"),
    "a_comment": (patched(poke(b"PK\x05\x06", 20, b"\x01\x00")), "zip end record"),
    "two_disks": (patched(poke(b"PK\x05\x06", 4, b"\x01\x00")), "zip end record"),
    "more_entries_than_records": (patched(poke(b"PK\x05\x06", 8, b"\x09\x00\x09\x00")), "zip directory"),
    "fewer_entries_than_records": (patched(poke(b"PK\x05\x06", 8, b"\x02\x00\x02\x00")), "zip directory"),
    "too_many_entries": (patched(poke(b"PK\x05\x06", 8, b"\xff\xff\xff\xff")), "zip entries"),
    "deflated": (repack(compression=zipfile.ZIP_DEFLATED), f"{MANIFEST}: compression"),
    "lzma": (repack(compression=zipfile.ZIP_LZMA), f"{MANIFEST}: compression"),
    "encrypted": (patched(poke(CENTRAL_MAGIC, 8, b"\x01\x00")), f"{MANIFEST}: zip flags"),
    "data_descriptor": (patched(poke(CENTRAL_MAGIC, 8, b"\x08\x00")), f"{MANIFEST}: zip flags"),
    "two_sizes": (patched(poke(CENTRAL_MAGIC, 24, b"\xff\xff\x00\x00")), f"{MANIFEST}: size"),
    "beyond_the_end": (
        patched(poke(CENTRAL_MAGIC, 20, b"\xff\xff\xff\x7f" * 2)),
        f"{MANIFEST}: local header",
    ),
    "offset_beyond": (patched(poke(CENTRAL_MAGIC, 42, b"\xff\xff\xff\x7f")), f"{MANIFEST}: offset"),
    "another_local_name": (patched(poke(b"manifest.json", 0, b"manifesto.jsn")), f"{MANIFEST}: local header"),
    "overlap": (patched(overlapping), "idle.safetensors: start"),
    "same_name_twice": (patched(twice), "deform.onnx"),
    "parent_folder": (extra_entry("../evil"), "entry name"),
    "parent_folder_inside": (extra_entry("tensors/../../evil"), "entry name"),
    "absolute": (extra_entry("/etc/passwd"), "entry name"),
    "drive_letter": (extra_entry("C:\\evil"), "entry name"),
    "unknown_entry": (extra_entry("readme.txt"), "entry name"),
    "a_pickle": (extra_entry("data.pkl"), "entry name"),
    "manifest_bit": (patched(lambda d: d.replace(b'"opencv"', b'"opencw"')), f"{MANIFEST}: crc32"),
    "preview_bit": (patched(lambda d: d.replace(b"IHDR", b"IHDS")), "sha256"),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_archive(name: str, sound: Path, tmp_path: Path) -> None:
    write, field = ARCHIVES[name]
    path = tmp_path / "bad.cap4d"
    write(Forge(sound), path)
    assert refusal(path).field == field


def test_a_file_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.cap4d"
    with open(path, "wb") as file:
        file.truncate((1 << 30) + 1)  # sparse: takes no space
    assert refusal(path).field == "size"


# The manifest ------------------------------------------------------------


def put(value: object, *keys: str | int) -> Callable[[Forge], None]:
    """Sets a field of the manifest."""

    def change(forge: Forge) -> None:
        at = forge.manifest
        for key in keys[:-1]:
            at = at[key]
        at[keys[-1]] = value

    return change


def drop(*keys: str) -> Callable[[Forge], None]:
    def change(forge: Forge) -> None:
        at = forge.manifest
        for key in keys[:-1]:
            at = at[key]
        del at[keys[-1]]

    return change


def raw(change: Callable[[str], str]) -> Callable[[Forge], None]:
    def write(forge: Forge) -> None:
        forge.raw_manifest = change(json.dumps(forge.manifest)).encode()

    return write


def on_mesh_of(points: int) -> Callable[[Forge], None]:
    """Says that the rig stands on as many points as its mesh has."""

    def change(forge: Forge) -> None:
        forge.manifest["rig"]["points"] = "mesh"
        forge.manifest["counts"] |= {"rig_points": points, "rig_vertices": points}

    return change


def vast_grid(**counts: int) -> Callable[[Forge], None]:
    """Few points of the rig, to be mixed onto a million of the grid."""
    return lambda forge: forge.manifest["counts"].update(grid_size=1024, grid_vertices=1 << 20, **counts)


def no_grid(forge: Forge) -> None:
    """Says that the Gaussians ride on the rig's own triangles."""
    on_mesh_of(forge.manifest["counts"]["grid_vertices"])(forge)
    forge.manifest["counts"]["grid_size"] = 0


MANIFESTS = {
    "not_json": (raw(lambda t: t[:-1]), "JSON"),
    "not_text": (lambda f: setattr(f, "raw_manifest", b"\xff\xfe{}"), "JSON"),
    "not_an_object": (raw(lambda t: "[]"), "JSON"),
    "nan": (raw(lambda t: t.replace('"fps": 24.0', '"fps": NaN')), "JSON"),
    "a_key_twice": (raw(lambda t: '{"format": "cap4d", ' + t[1:]), "JSON"),
    "deep": (raw(lambda t: "[" * 100_000), "JSON"),
    "endless_number": (raw(lambda t: t.replace('"version": 1', '"version": ' + "1" * 5000)), "JSON"),
    "too_large": (raw(lambda t: t + " " * (1 << 20)), "size"),
    "another_format": (put("gltf", "format"), "format"),
    "newer": (put(4, "version"), "version"),
    "version_zero": (put(0, "version"), "version"),
    "version_text": (put("1", "version"), "version"),
    "version_flag": (put(True, "version"), "version"),
    "other_axes": (put("opengl", "axes"), "axes"),
    "other_units": (put("millimetre", "units"), "units"),
    "other_rig_axes": (put("z_up", "rig", "axes"), "rig.axes"),
    "unknown_field": (put(1, "plugin"), "plugin"),
    "unknown_rig_field": (put(1, "rig", "script"), "rig.script"),
    "missing_field": (drop("precision"), "precision"),
    "missing_camera": (drop("camera"), "camera"),
    "precision": (put("float8", "precision"), "precision"),
    "points": (put("cloud", "rig", "points"), "rig.points"),
    "points_count": (put("mesh", "rig", "points"), "counts.rig_points"),
    "points_not_fewer_than_the_grid": (on_mesh_of(64), "counts.rig_points"),
    "mixing_bomb": (vast_grid(expressions=128), "counts.expressions"),
    "posing_bomb": (vast_grid(expressions=1, joints=64), "counts.joints"),
    "empty_name": (put("", "rig", "name"), "rig.name"),
    "long_name": (put("x" * 65, "rig", "licence"), "rig.licence"),
    "escape_in_a_name": (put("\x1b[31m", "rig", "name"), "rig.name"),
    "newline_in_a_name": (put("a\nb", "rig", "name"), "rig.name"),
    "joint": (put("tail", "rig", "joints", 0), "rig.joints"),
    "joint_object": (put({}, "rig", "joints", 0), "rig.joints"),
    "joint_count": (put(["eyes"], "rig", "joints"), "rig.joints"),
    "expression_twice": (put("eyeBlinkLeft", "rig", "expressions", 0, "name"), "rig.expressions"),
    "expression_range": (put([1, 0], "rig", "expressions", 0, "range"), "rig.expressions"),
    "expression_huge": (put([0, 1e300], "rig", "expressions", 1, "range"), "rig.expressions[1].range"),
    "expression_count": (put([], "rig", "expressions"), "rig.expressions"),
    "count_negative": (put(-1, "counts", "gaussians"), "counts.gaussians"),
    "count_huge": (put(1 << 40, "counts", "gaussians"), "counts.gaussians"),
    "count_fraction": (put(1.5, "counts", "faces"), "counts.faces"),
    "count_sh": (put(5, "counts", "sh_coefficients"), "counts.sh_coefficients"),
    "count_small_grid": (put(7, "counts", "grid_size"), "counts.grid_size"),
    "no_grid_in_version_1": (no_grid, "version"),
    "count_grid": (put(65, "counts", "grid_vertices"), "counts.grid_vertices"),
    "camera_size": (put(0, "camera", "width"), "camera.width"),
    "camera_huge": (put(1 << 20, "camera", "height"), "camera.height"),
    "camera_focal": (put(0, "camera", "K", 0, 0), "camera.K"),
    "camera_skew": (put(3, "camera", "K", 0, 1), "camera.K"),
    "camera_shape": (put([[1, 0], [0, 1]], "camera", "K"), "camera.K"),
    "camera_text": (put("x", "camera", "viewmat", 0, 0), "camera.viewmat"),
    "camera_scaled": (put(2.0, "camera", "viewmat", 0, 0), "camera.viewmat"),
    "camera_row": (put(1.0, "camera", "viewmat", 3, 0), "camera.viewmat"),
    "idle_fps": (put(0, "idle", "fps"), "idle.fps"),
    "idle_infinite": (raw(lambda t: t.replace('"fps": 24.0', '"fps": 1e999')), "idle.fps"),
    "entry_missing": (drop("entries", PREVIEW), f"entries.{PREVIEW}"),
    "entry_unknown": (put({"size": 1, "sha256": "0" * 64}, "entries", "x"), "entries.x"),
    "entry_size": (put(3, "entries", IDLE, "size"), "size"),
    "entry_negative": (put(-3, "entries", IDLE, "size"), f"entries.{IDLE}.size"),
    "hash": (put("0" * 64, "entries", RIG, "sha256"), "sha256"),
    "hash_form": (put("zz", "entries", RIG, "sha256"), f"entries.{RIG}.sha256"),
    "entry_not_in_zip": (lambda f: f.entries.pop(ONNX), "entry"),
    "entry_not_listed": (drop("entries", ONNX), "entry"),
    "mixed_in_version_1": (put("mixed", "precision"), "version"),
    "tiers_in_version_1": (put({"off": {"rms_mm": 1, "max_mm": 2}}, "deformer"), "version"),
    "int8_in_version_1": (put({"size": 1, "sha256": "0" * 64}, "entries", INT8), "version"),
}


@pytest.mark.parametrize("name", MANIFESTS)
def test_manifest(name: str, sound: Path, tmp_path: Path) -> None:
    change, field = MANIFESTS[name]
    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    change(forge)
    forge.write(path)
    assert refusal(path).field == field


def test_no_manifest(sound: Path, tmp_path: Path) -> None:
    path = tmp_path / "bad.cap4d"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in Forge(sound).entries.items():
            archive.writestr(name, data)
    assert refusal(path).source.endswith(MANIFEST)


# Tensors ------------------------------------------------------------


def at(entry: str, name: str, index: object, value: float) -> tuple[str, Callable[[dict], None]]:
    """Sets elements of one tensor."""

    def change(tensors: dict[str, np.ndarray]) -> None:
        tensors[name][index] = value

    return entry, change


def remade(
    entry: str, name: str, make: Callable[[np.ndarray], np.ndarray]
) -> tuple[str, Callable[[dict], None]]:
    def change(tensors: dict[str, np.ndarray]) -> None:
        tensors[name] = make(tensors[name])

    return entry, change


def swap_rows(value: np.ndarray) -> np.ndarray:
    return value[[1, 0, *range(2, len(value))]]


TENSOR_ABUSE = {
    "missing": ((GAUSSIANS, lambda t: t.pop("sh")), "sh"),
    "unknown": ((GAUSSIANS, lambda t: t.update(payload=np.zeros(3, np.float32))), "tensors"),
    "float64": (remade(GAUSSIANS, "means", np.float64), "means"),
    "float16_in_float32": (remade(GAUSSIANS, "means", np.float16), "means"),
    "index_int64": (remade(GRID, "faces", np.int64), "faces"),
    "index_wider_than_needed": (remade(GRID, "faces", np.uint32), "faces"),
    "fewer_gaussians": (remade(GAUSSIANS, "means", lambda v: v[1:]), "means"),
    "another_rank": (remade(GAUSSIANS, "opacity_logits", lambda v: v[:, None]), "opacity_logits"),
    "sh_count": (remade(GAUSSIANS, "sh", lambda v: v[:, :1]), "sh"),
    "empty": (remade(RIG, "neutral", lambda v: v[:0]), "neutral"),
    "nan_mean": (at(GAUSSIANS, "means", (3, 1), np.nan), "means"),
    "infinite_opacity": (at(GAUSSIANS, "opacity_logits", 0, np.inf), "opacity_logits"),
    "nan_basis": (at(RIG, "expression_basis", (0, 0, 0), np.nan), "expression_basis"),
    "nan_neutral_deformation": (at(GRID, "deform_neutral", 0, -np.inf), "deform_neutral"),
    "millimetres": (remade(RIG, "neutral", lambda v: v * 1000), "neutral"),
    "huge_scale": (at(GAUSSIANS, "log_scales", 0, 80), "log_scales"),
    "no_rotation": (at(GAUSSIANS, "quats", 5, 0), "quats"),
    "face_beyond": (at(GRID, "faces", (0, 0), 60_000), "faces"),
    "face_repeats": (remade(GRID, "faces", lambda v: v[:, [0, 0, 1]]), "faces"),
    "binding_beyond": (at(GAUSSIANS, "binding", 0, 60_000), "binding"),
    "vertex_beyond": (at(GRID, "vertices", (0, 0), 60_000), "vertices"),
    "pixel_beyond": (at(GRID, "pixels", (0, 0), SIZE), "pixels"),
    "pixel_twice": (remade(GRID, "pixels", lambda v: v[[0, 0, *range(2, len(v))]]), "pixels"),
    "pixels_out_of_order": (remade(GRID, "pixels", swap_rows), "pixels"),
    "flag": (at(GRID, "deformable", 0, 2), "deformable"),
    "bary_negative": (at(GRID, "bary", (0, 0), -3), "bary"),
    "bary_sum": (remade(GRID, "bary", lambda v: v * np.float32(0.5)), "bary"),
    "skin_sum": (remade(RIG, "skin_weights", np.ones_like), "skin_weights"),
    "skin_negative": (at(RIG, "skin_weights", (0, 0), -1), "skin_weights"),
    "pose_without_place": ((IDLE, lambda t: t.update(rot=np.zeros_like(t["eye_rot"]))), "rot, tra"),
    "idle_length": (remade(IDLE, "eye_rot", lambda v: v[1:]), "eye_rot"),
    "idle_expressions": (remade(IDLE, "expr", lambda v: v[:, 1:]), "expr"),
    "idle_nan": (at(IDLE, "expr", (0, 0), np.nan), "expr"),
}


@pytest.mark.parametrize("name", TENSOR_ABUSE)
def test_tensors(name: str, sound: Path, tmp_path: Path) -> None:
    (entry, change), field = TENSOR_ABUSE[name]
    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    forge.tensors(entry, change)
    forge.sign()
    forge.write(path)
    error = refusal(path)
    assert error.field == field and error.source == f"{path}:{entry}"


def header(text: str, data: bytes = b"") -> bytes:
    return struct.pack("<Q", len(text)) + text.encode() + data


ONE = '{"dtype":"F32","shape":[1],"data_offsets":[0,4]}'
OVERLAP = f'{{"a":{ONE},"b":{ONE}}}'


@pytest.mark.parametrize(
    "data",
    [
        b"x",
        struct.pack("<Q", 1 << 62) + b"{}",
        header("{"),
        header("[" * 5000),
        header('{"a":{"dtype":"F32","shape":[1000000000],"data_offsets":[0,4]}}', b"\0" * 4),
        header('{"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}', b"\0" * 4),
        header('{"a":{"dtype":"F32","shape":[1],"data_offsets":[4,0]}}', b"\0" * 4),
        header(OVERLAP, b"\0" * 4),
        header('{"a":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}', b"\0" * 4),
    ],
    ids=["short", "length", "json", "deep", "larger_than_data", "negative", "backwards", "overlap", "dtype"],
)
def test_broken_safetensors(data: bytes, sound: Path, tmp_path: Path) -> None:
    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    forge.entries[IDLE] = data
    forge.sign()
    forge.write(path)
    assert refusal(path).source == f"{path}:{IDLE}"


# Version 2 ------------------------------------------------------------


@pytest.fixture(scope="module")
def compact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound file of version 2: all packed tensors int8, the expression basis masked."""
    bundle = tiny_bundle(SIZE, gaussians=1, mesh=False)
    basis = bundle.subject.expression_basis.copy()
    basis[:, 9:] = 0
    linear = np.zeros_like(basis)
    linear[:, bundle.grid.deformable] = 1e-3
    bundle = replace(
        bundle,
        subject=replace(bundle.subject, expression_basis=basis),
        deform_int8=random_network(SIZE, 1),
        deform_linear=linear,
        tier_errors={"int8": (0.1, 0.2)},
    )
    path = tmp_path_factory.mktemp("compact") / "compact.cap4d"
    write_bundle(bundle, path, precision=dict.fromkeys(PACKED, "int8"))
    return path


def test_the_compact_file_is_what_its_abuse_needs(compact: Path) -> None:
    tensors = load(Forge(compact).entries[RIG])
    assert tensors["expression_basis"].shape == (5 * 9, 3) and "expression_basis.mask" in tensors
    assert tensors["expression_basis"].dtype == np.int8 == load(Forge(compact).entries[GAUSSIANS])["sh"].dtype
    assert read_bundle(compact).tier_errors == {"int8": (0.1, 0.2)}


COMPACT_MANIFESTS = {
    "version_1": (put(1, "version"), "version"),
    "another_precision": (put("float32", "precision"), "deform_linear.steps"),
    "tier": (put({"int4": {"rms_mm": 0, "max_mm": 0}}, "deformer"), "deformer.int4"),
    "tier_list": (put([], "deformer"), "deformer"),
    "tier_number": (put(1, "deformer", "int8"), "deformer.int8"),
    "tier_field": (put(1, "deformer", "int8", "p99_mm"), "deformer.int8.p99_mm"),
    "tier_field_missing": (drop("deformer", "int8", "max_mm"), "deformer.int8.max_mm"),
    "tier_error_negative": (put(-1, "deformer", "int8", "rms_mm"), "deformer.int8.rms_mm"),
    "tier_error_text": (put("0", "deformer", "int8", "rms_mm"), "deformer.int8.rms_mm"),
    "tier_error_huge": (put(1e5, "deformer", "int8", "max_mm"), "deformer.int8.max_mm"),
    "tier_error_infinite": (raw(lambda t: t.replace('"rms_mm": 0.1', '"rms_mm": 1e999')),
                            "deformer.int8.rms_mm"),
}  # fmt: skip


@pytest.mark.parametrize("name", COMPACT_MANIFESTS)
def test_manifest_of_version_2(name: str, compact: Path, tmp_path: Path) -> None:
    change, field = COMPACT_MANIFESTS[name]
    forge, path = Forge(compact), tmp_path / "bad.cap4d"
    change(forge)
    forge.write(path)
    assert refusal(path).field == field


def added(entry: str, name: str, value: np.ndarray) -> tuple[str, Callable[[dict], None]]:
    return entry, lambda tensors: tensors.update({name: value})


BASIS, STEPS, MASK = "expression_basis", "expression_basis.steps", "expression_basis.mask"
COMPACT_ABUSE = {
    "int8_without_steps": ((GAUSSIANS, lambda t: t.pop("sh.steps")), "sh"),
    "steps_of_a_float": (remade(GAUSSIANS, "sh", np.float32), "sh"),
    "steps_without_a_tensor": ((GAUSSIANS, lambda t: t.pop("sh")), "tensors"),
    "steps_of_an_index": (added(GAUSSIANS, "binding.steps", np.zeros(2, np.float32)), "tensors"),
    "steps_of_a_plain_float": (added(RIG, "neutral.steps", np.zeros((3, 2), np.float32)), "tensors"),
    "steps_of_steps": (added(GAUSSIANS, "sh.steps.steps", np.zeros(2, np.float32)), "tensors"),
    "steps_too_few": (remade(GAUSSIANS, "sh.steps", lambda v: v[:1]), "sh.steps"),
    "steps_transposed": (remade(GAUSSIANS, "quats.steps", lambda v: v.T), "quats.steps"),
    "steps_of_columns_for_rows": (remade(RIG, STEPS, lambda v: v[:3]), STEPS),
    "steps_float16": (remade(GAUSSIANS, "sh.steps", np.float16), "sh.steps"),
    "steps_nan": (at(GAUSSIANS, "means.steps", (0, 0), np.nan), "means.steps"),
    "steps_infinite": (at(GAUSSIANS, "means.steps", (0, 1), np.inf), "means.steps"),
    "steps_negative": (at(RIG, STEPS, (0, 0), -1e-3), STEPS),
    "steps_overflow": (at(GAUSSIANS, "means.steps", (0, 0), 3e38), "means"),
    "out_of_range_once_unpacked": (at(GAUSSIANS, "log_scales.steps", (0, 1), 100), "log_scales"),
    "millimetres": (at(RIG, STEPS, (0, 0), 1), BASIS),
    "no_rotation_once_unpacked": (remade(GAUSSIANS, "quats.steps", np.zeros_like), "quats"),
    "int8_shape": (remade(GAUSSIANS, "means", lambda v: v[1:]), "means"),
    "uint8": (remade(GAUSSIANS, "means", lambda v: v.view(np.uint8)), "means"),
    "mask_gone": ((RIG, lambda t: t.pop(MASK)), BASIS),
    "mask_of_gaussians": (added(GAUSSIANS, "sh.mask", np.zeros((1, 1), np.uint8)), "tensors"),
    "mask_of_another_row_count": (remade(RIG, MASK, lambda v: v[1:]), MASK),
    "mask_of_another_length": (remade(RIG, MASK, lambda v: v[:, 1:]), MASK),
    "mask_of_bytes": (remade(RIG, MASK, lambda v: v.astype(np.uint16)), MASK),
    "mask_without_a_tensor": ((RIG, lambda t: (t.pop(BASIS), t.pop(STEPS))), "tensors"),
    "mask_of_more_points": (at(RIG, MASK, (0, 3), 0x10), BASIS),
    "mask_of_fewer_points": (at(RIG, MASK, (0, 0), 0), BASIS),
    "mask_beyond_the_points": (at(RIG, MASK, (0, -1), 0x80), MASK),
    "masked_points_of_two": (remade(RIG, BASIS, lambda v: v[:, :2]), BASIS),
    "linear_where_nothing_deforms": (
        remade(GRID, "deformable", lambda v: v * (np.arange(len(v)) < 50)), "deform_linear"),
    "int8_network_of_floats": (remade(INT8, "down1.weight", np.float32), "down1.weight"),
    "int8_network_without_tensors": ((INT8, lambda t: t.clear()), "down0.weight"),
}  # fmt: skip


@pytest.mark.parametrize("name", COMPACT_ABUSE)
def test_tensors_of_version_2(name: str, compact: Path, tmp_path: Path) -> None:
    (entry, change), field = COMPACT_ABUSE[name]
    forge, path = Forge(compact), tmp_path / "bad.cap4d"
    forge.tensors(entry, change)
    forge.sign()
    forge.write(path)
    error = refusal(path)
    assert error.field == field and error.source == f"{path}:{entry}"


def test_companions_in_version_1_are_refused(sound: Path, tmp_path: Path) -> None:
    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    forge.tensors(*added(GRID, "deform_linear", np.zeros((5, 52, 3), np.float32)))
    forge.sign()
    forge.write(path)
    assert refusal(path).field == "tensors"
    forge = Forge(sound)
    forge.tensors(*added(RIG, MASK, np.zeros((5, 7), np.uint8)))
    forge.sign()
    forge.write(path)
    assert refusal(path).field == "tensors"


# Pictures and networks ------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "field"),
    [
        (b"GIF89a" + b"\0" * 64, "signature"),
        (b"\x89PNG\r\n\x1a\n", "signature"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", 1 << 30, 1 << 30) + b"\0" * 20, "size"),
    ],
    ids=["another_kind", "short", "huge"],
)
def test_preview(data: bytes, field: str, sound: Path, tmp_path: Path) -> None:
    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    forge.entries[PREVIEW] = data
    forge.sign()
    forge.write(path)
    assert refusal(path).field == field


def external(model) -> None:
    tensor = model.graph.initializer[1]
    tensor.ClearField("raw_data")
    tensor.data_location = 1
    tensor.external_data.add(key="location", value="/etc/passwd")


def external_without_flag(model) -> None:
    model.graph.initializer[1].external_data.add(key="location", value="weights.bin")


def flagged_external(model) -> None:
    model.graph.initializer[1].data_location = 1


def subgraph(model) -> None:
    node = model.graph.node[0]
    node.attribute.add(name="body", type=5).g.name = "inner"


def operator(name: str) -> Callable:
    return lambda model: setattr(model.graph.node[0], "op_type", name)


def dims(*sizes: int | str) -> Callable:
    def change(model) -> None:
        shape = model.graph.input[0].type.tensor_type.shape
        del shape.dim[:]
        for size in sizes:
            shape.dim.add(**({"dim_param": size} if isinstance(size, str) else {"dim_value": size}))

    return change


def nan_weight(model) -> None:
    tensor = model.graph.initializer[1]
    tensor.raw_data = np.full(len(tensor.raw_data) // 4, np.nan, np.float32).tobytes()


def nan_list(model) -> None:
    """A weight as a typed list instead of bytes, which is as good to a runtime."""
    tensor = model.graph.initializer[1]
    tensor.ClearField("raw_data")
    tensor.float_data.extend([float("nan")] * int(np.prod(tensor.dims)))


def constant(**attribute) -> Callable:
    return lambda model: model.graph.node.insert(0, onnx.helper.make_node("Constant", [], ["c"], **attribute))


def lying_dims(model) -> None:
    model.graph.initializer[1].dims[0] = 1 << 30


NETWORKS = {
    "external_data": (external, "TensorProto"),
    "external_data_unflagged": (external_without_flag, "TensorProto"),
    "external_flag_only": (flagged_external, "tensor.data_location"),
    "foreign_domain": (lambda m: m.opset_import.add(domain="evil.ops", version=1), "opset_import.domain"),
    "foreign_operator": (lambda m: setattr(m.graph.node[0], "domain", "evil.ops"), "node.domain"),
    "loop": (operator("Loop"), "node.op_type"),
    "if": (operator("If"), "node.op_type"),
    "bomb": (operator("ConstantOfShape"), "node.op_type"),
    "random": (operator("RandomNormal"), "node.op_type"),
    "subgraph": (subgraph, "AttributeProto"),
    "function": (lambda m: m.functions.add(name="f"), "ModelProto"),
    "training": (lambda m: m.training_info.add(), "ModelProto"),
    "sparse": (lambda m: m.graph.sparse_initializer.add(), "GraphProto"),
    "strings": (lambda m: m.graph.initializer[1].string_data.append(b"x"), "TensorProto"),
    "second_input": (lambda m: m.graph.input.add().CopyFrom(m.graph.input[0]), "graph.input"),
    "no_output": (lambda m: m.graph.ClearField("output"), "graph.output"),
    "another_input": (lambda m: setattr(m.graph.input[0], "name", "x"), "graph.input"),
    "another_size": (dims(1, 3, 999, 999), "graph.input.shape"),
    "open_size": (dims(1, 3, "h", "w"), "graph.input.shape"),
    "another_dtype": (
        lambda m: setattr(m.graph.output[0].type.tensor_type, "elem_type", 10),
        "graph.output.elem_type",
    ),
    "weights_short": (lambda m: setattr(m.graph.initializer[1], "raw_data", b"\0" * 8), "tensor.raw_data"),
    "weights_nan": (nan_weight, "tensor.raw_data"),
    "weights_nan_in_a_list": (nan_list, "TensorProto"),
    "weights_missing": (lambda m: m.graph.initializer[1].ClearField("raw_data"), "tensor.raw_data"),
    "constant_nan": (constant(value_float=float("nan")), "attribute.floats"),
    "constant_infinite": (constant(value_floats=[0.0, float("inf")]), "attribute.floats"),
    "dims_lie": (lying_dims, "tensor.raw_data"),
    "dims_negative": (lambda m: m.graph.initializer[1].dims.insert(0, -1), "tensor.dims"),
    "string_tensor": (lambda m: setattr(m.graph.initializer[1], "data_type", 8), "tensor.data_type"),
    "old_opset": (lambda m: setattr(m.opset_import[0], "version", 7), "opset_import.version"),
    "future_opset": (lambda m: setattr(m.opset_import[0], "version", 999), "opset_import.version"),
    "no_graph": (lambda m: m.ClearField("graph"), "graph"),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_network(name: str, sound: Path, tmp_path: Path) -> None:
    change, field = NETWORKS[name]
    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    forge.network(change)
    forge.sign()
    forge.write(path)
    error = refusal(path)
    assert error.field == field and error.source == f"{path}:{ONNX}"


def field(number: int, payload: bytes, *, wire: int = 2) -> bytes:
    """A field of protobuf's wire format; wire type 2 is preceded by its length."""
    length, left = b"", len(payload)
    while wire == 2 and (left or not length):
        length, left = length + bytes([left & 0x7F | (0x80 if left > 0x7F else 0)]), left >> 7
    return bytes([number << 3 | wire]) + length + payload


def with_constant(network: bytes, attribute: bytes) -> bytes:
    """The network with one more node, a Constant, whose attribute is these bytes."""
    model = onnx.load_from_string(network)
    node = field(2, b"c") + field(4, b"Constant") + field(5, field(1, b"value") + attribute)
    graph = model.graph.SerializeToString() + field(1, node)
    model.ClearField("graph")
    return model.SerializeToString() + field(7, graph)


def test_what_a_parser_would_read_differently_is_refused(sound: Path) -> None:
    network = Forge(sound).entries[ONNX]
    tensor = onnx.numpy_helper.from_array(np.zeros(2, np.float32)).SerializeToString()
    scan_onnx(with_constant(network, field(5, tensor)), source="x", size=SIZE)

    merged = onnx.AttributeProto.FromString(2 * field(5, tensor)).t
    assert (list(merged.dims), len(merged.raw_data)) == ([2, 2], 8), "sizes and bytes disagree"
    with pytest.raises(DataError, match=r"attribute\.t: expected one tensor"):
        scan_onnx(with_constant(network, 2 * field(5, tensor)), source="x", size=SIZE)

    of_8_bytes = field(1, b"\x02", wire=0) + field(2, b"\x01", wire=0) + field(9, bytes(8), wire=1)
    assert not onnx.TensorProto.FromString(of_8_bytes).raw_data, "passed over, as of another wire type"
    with pytest.raises(DataError, match="TensorProto: expected another wire type for field 9"):
        scan_onnx(with_constant(network, field(5, of_8_bytes)), source="x", size=SIZE)


def test_a_network_that_passes_the_scan_but_is_not_sound_is_refused_when_loaded(sound: Path) -> None:
    from cap4d.player.deformer import Deformer

    forge = Forge(sound)
    forge.network(lambda m: m.graph.node[1].input.__setitem__(0, "nowhere"))
    scan_onnx(forge.entries[ONNX], source="x", size=SIZE)
    with pytest.raises(DataError, match="network"):
        Deformer(forge.entries[ONNX], size=SIZE)


# Chance ------------------------------------------------------------


def same(a: Bundle, b: Bundle) -> bool:
    arrays = (
        "means",
        "quats",
        "log_scales",
        "opacity_logits",
        "sh",
        "binding",
        "deform_neutral",
        "expression_range",
    )
    grids = ("pixels", "faces", "deformable", "vertices", "bary")
    return (
        all(np.array_equal(getattr(a, n), getattr(b, n)) for n in arrays)
        and all(np.array_equal(getattr(a.grid, n), getattr(b.grid, n)) for n in grids)
        and np.array_equal(a.subject.expression_basis, b.subject.expression_basis)
        and np.array_equal(a.subject.neutral, b.subject.neutral)
        and (a.deform_onnx, a.preview, a.rig_name, a.rig_licence)
        == (b.deform_onnx, b.preview, b.rig_name, b.rig_licence)
        and np.array_equal(a.idle.expr, b.idle.expr)
        and np.array_equal(a.camera.viewmat, b.camera.viewmat)
    )


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Flips, cuts, repeats or removes something; half of the time near the end, where the structure is."""
    changed = bytearray(data)
    where = (
        int(rng.integers(len(data)))
        if rng.random() < 0.5
        else len(data) - 1 - int(rng.integers(min(900, len(data))))
    )
    kind = rng.integers(5)
    if kind == 0:
        changed[where] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        changed[where : where + 4] = rng.bytes(len(changed[where : where + 4]))
    elif kind == 2:
        del changed[where:]
    elif kind == 3:
        del changed[where : where + int(rng.integers(1, 64))]
    else:
        changed[where:where] = changed[where : where + int(rng.integers(1, 64))]
    return bytes(changed)


def test_damaged_files_load_as_they_were_or_are_refused(sound: Path, tmp_path: Path) -> None:
    rng, path = np.random.default_rng(7), tmp_path / "fuzz.cap4d"
    original, data, refused = read_bundle(sound), sound.read_bytes(), 0
    for _ in range(400):
        path.write_bytes(damaged(data, rng))
        try:
            assert same(read_bundle(path), original)
        except DataError:
            refused += 1
    assert refused > 300


@pytest.mark.parametrize("file", ["sound", "compact"])
@pytest.mark.parametrize("entry", [MANIFEST, GRID, RIG, GAUSSIANS, IDLE, ONNX, INT8, PREVIEW])
def test_damaged_entries_with_fitting_hashes_raise_nothing_but_data_errors(
    entry: str, file: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    sound: Path = request.getfixturevalue(file)
    if entry not in ({MANIFEST} | Forge(sound).entries.keys()):
        pytest.skip("version 1 has no such entry")
    rng, path = np.random.default_rng(11), tmp_path / "fuzz.cap4d"
    refused = 0
    for _ in range(60):
        forge = Forge(sound)
        if entry == MANIFEST:
            forge.raw_manifest = damaged(json.dumps(forge.manifest).encode(), rng)
        else:
            # The head of a file is where its structure is: look there more often than chance would.
            data = forge.entries[entry]
            cut = min(len(data), 1500) if rng.random() < 0.7 else len(data)
            forge.entries[entry] = damaged(data[:cut], rng) + data[cut:]
            forge.sign()
        forge.write(path)
        try:
            read_bundle(path)
        except DataError:
            refused += 1
    assert refused > 0


# The command line ------------------------------------------------------------


@pytest.mark.parametrize("command", ["inspect", "render", "view"])
@pytest.mark.parametrize("name", ["cut", "hash", "index", "nan", "external_data"])
def test_commands_refuse_in_one_line_and_write_nothing(
    name: str, command: str, sound: Path, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    """The issue's list of hostile files, as a user meets them."""
    from cap4d.cli import main

    forge, path = Forge(sound), tmp_path / "bad.cap4d"
    if name == "hash":
        forge.manifest["entries"][ONNX]["sha256"] = "0" * 64
    elif name == "external_data":
        forge.network(external)
        forge.sign()
    elif name in ("index", "nan"):
        tensor, value = ("binding", 60_000) if name == "index" else ("sh", np.nan)
        forge.tensors(*at(GAUSSIANS, tensor, 0, value))
        forge.sign()
    forge.write(path)
    if name == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    output = str(tmp_path / "out.mp4")
    if command == "view":
        view = pytest.importorskip("cap4d.app.main").main
        code = view([str(path), "--headless", "--backend", "cpu", "--out", output])
    else:
        code = main([command, str(path), *(["-o", output] if command == "render" else [])])
    captured = capfd.readouterr()
    lines = (captured.out + captured.err).strip().splitlines()
    assert code == 1 and len(lines) == 1, lines
    assert f"{path}" in lines[0] and ": expected " in lines[0] and ", found " in lines[0]
    assert [p.name for p in tmp_path.iterdir()] == ["bad.cap4d"]


# Version 3 ------------------------------------------------------------


@pytest.fixture(scope="module")
def gridless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound file whose Gaussians ride on the rig's own triangles."""
    path = tmp_path_factory.mktemp("gridless") / "gridless.cap4d"
    write_bundle(tiny_bundle_on_mesh(SIZE, gaussians=1), path)
    return path


def with_entry(name: str) -> Callable[[Forge], None]:
    """A file with one more entry, listed and signed."""

    def change(forge: Forge) -> None:
        forge.entries[name] = b"x"
        forge.sign()

    return change


GRIDLESS_MANIFESTS = {
    "version_2": (put(2, "version"), "version"),
    "on_the_grid": (put("grid", "rig", "points"), "rig.points"),
    "vertices": (put(63, "counts", "grid_vertices"), "counts.grid_vertices"),
    "points": (put(63, "counts", "rig_points"), "counts.rig_points"),
    "with_a_grid": (put(SIZE, "counts", "grid_size"), "counts.rig_points"),
    "network": (with_entry(ONNX), f"entries.{ONNX}"),
    "network_in_whole_numbers": (with_entry(INT8), f"entries.{INT8}"),
    "tiers": (put({"off": {"rms_mm": 1, "max_mm": 2}}, "deformer"), "deformer"),
    "posing_bomb": (
        lambda f: f.manifest["counts"].update(
            grid_vertices=1 << 20, rig_points=1 << 20, rig_vertices=1 << 20, joints=64
        ),
        "counts.joints",
    ),
}


@pytest.mark.parametrize("name", GRIDLESS_MANIFESTS)
def test_manifest_without_a_grid(name: str, gridless: Path, tmp_path: Path) -> None:
    change, field = GRIDLESS_MANIFESTS[name]
    forge, path = Forge(gridless), tmp_path / "bad.cap4d"
    change(forge)
    forge.write(path)
    assert refusal(path).field == field


GRIDLESS_TENSORS = {
    "pixels": (added(GRID, "pixels", np.zeros((64, 2), np.uint16)), "tensors"),
    "bary": (added(GRID, "bary", np.full((64, 3), 1 / 3, np.float32)), "tensors"),
    "deform_neutral": (added(GRID, "deform_neutral", np.zeros((64, 3), np.float32)), "tensors"),
    "lines": (added(GRID, "deform_linear", np.zeros((5, 64, 3), np.float32)), "tensors"),
    "masked_lines": (
        (GRID, lambda t: t.update({"deform_linear": np.zeros((0, 3), np.float32),
                                   "deform_linear.mask": np.zeros((5, 8), np.uint8)})),
        "tensors",
    ),
    "face_beyond": (at(GRID, "faces", (0, 0), 64), "faces"),
    "face_repeats": (remade(GRID, "faces", lambda v: v[:, [0, 0, 1]]), "faces"),
    "no_faces": ((GRID, lambda t: t.pop("faces")), "faces"),
    "binding_beyond": (at(GAUSSIANS, "binding", 0, 98), "binding"),
    "fewer_points": (remade(RIG, "neutral", lambda v: v[:-1]), "neutral"),
}  # fmt: skip


@pytest.mark.parametrize("name", GRIDLESS_TENSORS)
def test_tensors_without_a_grid(name: str, gridless: Path, tmp_path: Path) -> None:
    (entry, change), field = GRIDLESS_TENSORS[name]
    forge, path = Forge(gridless), tmp_path / "bad.cap4d"
    forge.tensors(entry, change)
    forge.sign()
    forge.write(path)
    error = refusal(path)
    assert error.field == field and error.source == f"{path}:{entry}"
