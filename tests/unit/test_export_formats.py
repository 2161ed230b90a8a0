"""Gaussians written for other tools: read back by small readers of the tests' own, and looked at."""

from __future__ import annotations

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cap4d
from cap4d import cli
from cap4d.camera import Camera, orbit_camera
from cap4d.errors import ArgumentError
from cap4d.export.axes import y_up
from cap4d.export.frames import export_file, neutral, parse_range, pose, write_gaussians
from cap4d.export.glb import glb_bytes
from cap4d.export.ply import ply_bytes
from cap4d.export.splat import splat_bytes
from cap4d.export.spz import position_bits, spz_bytes
from cap4d.gaussians import SH_COUNTS, Gaussians
from cap4d.harmonics import rotate_sh
from cap4d.render import render
from cap4d.rotation import axis_angle_to_rotmat, quat_to_rotmat

FLIP = np.array([1.0, -1.0, -1.0])


def head(n: int = 3000, *, degree: int = 3, seed: int = 0) -> Gaussians:
    """A ball of Gaussians of a head's size that look different from everywhere; OpenCV axes."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3))
    means *= 0.1 / np.linalg.norm(means, axis=1, keepdims=True)
    quats = rng.normal(size=(n, 4)) * rng.uniform(0.5, 2, (n, 1))
    some = quats[:20]
    some[:] = np.eye(4)[np.arange(len(some)) % 4] + 1e-4 * rng.normal(size=some.shape)  # w near 0, too
    sh = rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.15
    sh[:, 0] = 1.5 * np.sin(30 * means)
    parts = (means, quats, np.exp(rng.normal(-5.2, 0.5, (n, 3))), rng.uniform(0.02, 1, n), sh)
    return Gaussians(*(np.ascontiguousarray(part, np.float32) for part in parts))


def view(yaw_deg: float = 25) -> Camera:
    return orbit_camera(
        yaw_deg=yaw_deg, pitch_deg=15, distance=0.5, target=np.zeros(3), fov_y_deg=30, width=96, height=96
    )


def psnr(a: Gaussians, b: Gaussians, *, camera: Camera | None = None, other: Camera | None = None) -> float:
    """dB between the two, on black; the second seen by `other` if that is another."""
    camera = camera or view()
    images = render(a, camera).rgb, render(b, other or camera).rgb
    return -10 * np.log10(np.square(np.clip(images[0], 0, 1) - np.clip(images[1], 0, 1)).mean() + 1e-12)


def covariances(gaussians: Gaussians) -> np.ndarray:
    axes = quat_to_rotmat(gaussians.quats.astype(float)) * gaussians.scales[:, None]
    return axes @ axes.swapaxes(1, 2)


def flipped_back(means, quats, scales, opacities, sh) -> Gaussians:
    """Gaussians of a file with y up in OpenCV's axes: by the signs of the harmonics, not by solving."""
    quats = quats[:, [1, 0, 3, 2]] * [-1, 1, -1, 1]  # half a turn about x, then the rest
    odd = np.array([0, 1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0])  # in y and z together
    parts = means * FLIP, quats, scales, opacities, sh * np.where(odd, -1, 1)[: sh.shape[1], None]
    return Gaussians(*(np.ascontiguousarray(part, np.float32) for part in parts))


def read_ply(data: bytes) -> Gaussians:
    text, _, body = data.partition(b"end_header\n")
    lines = text.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    n = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    assert names[:6] == ["x", "y", "z", "nx", "ny", "nz"] and len(names) == 62
    assert len(body) == 4 * n * len(names)
    column = dict(zip(names, np.frombuffer(body, "<f4").reshape(n, -1).T, strict=True))
    of = lambda *keys: np.stack([column[key] for key in keys], -1)  # noqa: E731
    rest = of(*(f"f_rest_{i}" for i in range(45))).reshape(n, 3, 15).swapaxes(1, 2)
    return Gaussians(
        of("x", "y", "z"),
        of(*(f"rot_{i}" for i in range(4))),
        np.exp(of(*(f"scale_{i}" for i in range(3)))),
        1 / (1 + np.exp(-column["opacity"])),
        np.concatenate([of("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], 1),
    )


def read_splat(data: bytes) -> Gaussians:
    rows = np.frombuffer(data, np.uint8).reshape(-1, 32)
    floats = np.ascontiguousarray(rows[:, :24]).view("<f4")
    quats = (rows[:, 28:].astype(np.float32) - 128) / 128
    sh = (rows[:, 24:27].astype(np.float32) / 255 - 0.5) / 0.28209479177387814
    return Gaussians(
        floats[:, :3].copy(), quats, floats[:, 3:].copy(), rows[:, 27] / np.float32(255), sh[:, None]
    )


def read_spz(data: bytes) -> tuple[Gaussians, int]:
    """And how many bits of the positions are fractions."""
    data = gzip.decompress(data)
    magic, version, n, degree, bits, flags, reserved = struct.unpack("<3I4B", data[:16])
    assert (magic, version, flags, reserved) == (0x5053474E, 2, 0, 0)
    count, body = (degree + 1) ** 2 - 1, np.frombuffer(data, np.uint8, offset=16)
    sizes = np.cumsum([9 * n, n, 3 * n, 3 * n, 3 * n, 3 * count * n])
    assert len(body) == sizes[-1]
    places, alphas, colors, scales, turns, rest = np.split(body, sizes[:-1])
    whole = places.reshape(n, 3, 3).astype(np.int64) @ [1, 256, 65536]
    whole = np.where(whole >= 1 << 23, whole - (1 << 24), whole)
    xyz = turns.reshape(n, 3) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(1)))
    sh = np.concatenate([
        ((colors.reshape(n, 1, 3) / 255) - 0.5) / 0.15,
        (rest.reshape(n, count, 3).astype(float) - 128) / 128,
    ], 1)  # fmt: skip
    quats = np.concatenate([w[:, None], xyz], 1)
    gaussians = flipped_back(whole / 2**bits, quats, np.exp(scales.reshape(n, 3) / 16 - 10), alphas / 255, sh)
    return gaussians, bits


def read_glb(data: bytes) -> tuple[Gaussians, dict]:
    magic, version, length, size, kind = struct.unpack("<5I", data[:20])
    assert (magic, version, length, kind) == (0x46546C67, 2, len(data), 0x4E4F534A) and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack("<2I", data[20 + size : 28 + size])
    binary = data[28 + size :]
    assert kind == 0x004E4942 and binary_size == len(binary) == document["buffers"][0]["byteLength"]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0

    def array(name: str) -> np.ndarray:
        accessor = document["accessors"][primitive["attributes"][name]]
        span = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126 and span["byteLength"] == 4 * width * accessor["count"]
        assert span["byteOffset"] % 4 == 0
        data = binary[span["byteOffset"] : span["byteOffset"] + span["byteLength"]]
        return np.frombuffer(data, "<f4").reshape(-1, width)

    prefix = "KHR_gaussian_splatting:"
    quats = array(prefix + "ROTATION")
    names = [f"{prefix}SH_DEGREE_{degree}_COEF_{m}" for degree in range(4) for m in range(2 * degree + 1)]
    sh = np.stack([array(name) for name in names if name in primitive["attributes"]], 1)
    return flipped_back(
        array("POSITION"),
        quats[:, [3, 0, 1, 2]],
        array(prefix + "SCALE"),
        array(prefix + "OPACITY")[:, 0],
        sh,
    ), document


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_harmonics_look_the_same_from_rotated_directions(degree):
    torch = pytest.importorskip("torch")
    from cap4d.raster.reference import eval_sh

    rng, count = np.random.default_rng(degree), (degree + 1) ** 2
    sh = rng.normal(size=(200, count, 3)).astype(np.float32)
    directions = rng.normal(size=(200, 3))
    for turn in (*rng.normal(size=(5, 3)), np.array([np.pi, 0, 0])):
        rotmat = axis_angle_to_rotmat(turn)
        turned = rotate_sh(sh, rotmat)
        before = eval_sh(torch.from_numpy(sh).double(), torch.from_numpy(directions), degree)
        after = eval_sh(torch.from_numpy(turned).double(), torch.from_numpy(directions @ rotmat.T), degree)
        np.testing.assert_allclose(after.numpy(), before.numpy(), atol=2e-6)
        np.testing.assert_allclose(rotate_sh(turned, rotmat.T), sh, atol=2e-6)


def test_y_up_looks_the_same_to_a_camera_that_is_turned_with_it():
    gaussians = head()
    for yaw in (-60, 10, 150):
        turned = replace(view(yaw), viewmat=view(yaw).viewmat @ np.diag([1, -1, -1, 1]))
        assert psnr(gaussians, y_up(gaussians), camera=view(yaw), other=turned) > 90
        assert psnr(gaussians, replace(y_up(gaussians), sh=gaussians.sh), camera=view(yaw), other=turned) < 40


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_ply_loses_nothing(degree):
    gaussians = head(degree=degree)
    found = read_ply(ply_bytes(gaussians))
    count = gaussians.sh.shape[1]
    np.testing.assert_array_equal(found.means, gaussians.means)
    np.testing.assert_array_equal(found.sh[:, :count], gaussians.sh)
    assert not found.sh[:, count:].any() and found.sh.shape[1] == 16
    np.testing.assert_allclose(found.scales, gaussians.scales, rtol=2e-6)
    np.testing.assert_allclose(found.opacities, gaussians.opacities, atol=1e-6)
    np.testing.assert_allclose(covariances(found), covariances(gaussians), atol=1e-9)
    assert psnr(gaussians, found) > 90


def test_a_ply_stays_finite_where_logarithms_are_not():
    gaussians = head(4)
    extreme = replace(gaussians, opacities=np.float32([0, 1, 0.5, 1]), scales=np.zeros_like(gaussians.scales))
    found = read_ply(ply_bytes(extreme))
    assert np.isfinite(np.frombuffer(ply_bytes(extreme).partition(b"end_header\n")[2], "<f4")).all()
    np.testing.assert_allclose(found.opacities, [0, 1, 0.5, 1], atol=1e-6)


def test_a_splat_keeps_what_its_bytes_hold():
    gaussians = head(degree=0)
    found = read_splat(splat_bytes(gaussians))
    seen = found.scales.prod(1) * found.opacities
    slack = found.scales.prod(1) * 1.1 / 255  # of opacities in a byte
    assert (np.diff(seen) <= slack[1:] + slack[:-1]).all(), "the most visible first"
    order = np.argsort(found.means[:, 0]), np.argsort(gaussians.means[:, 0])
    for name, tolerance in {"means": 0, "scales": 0, "opacities": 0.5 / 255, "sh": 0.0075}.items():
        pair = (getattr(g, name)[o] for g, o in zip((found, gaussians), order, strict=True))
        np.testing.assert_allclose(*pair, atol=1.01 * tolerance)
    assert psnr(gaussians, found) > 40


def test_a_splat_has_the_colour_of_no_direction():
    gaussians = head(degree=3)
    flat = replace(gaussians, sh=gaussians.sh[:, :1].copy())
    assert splat_bytes(gaussians) == splat_bytes(flat)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_an_spz_keeps_what_it_says(degree):
    gaussians = head(degree=degree)
    found, bits = read_spz(spz_bytes(gaussians))
    assert bits == 20 and found.sh.shape == gaussians.sh.shape
    np.testing.assert_allclose(found.means, gaussians.means, atol=0.51 * 2**-20)
    np.testing.assert_allclose(found.opacities, gaussians.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(0.2820948 * found.sh[:, 0], 0.2820948 * gaussians.sh[:, 0], atol=0.0037)
    np.testing.assert_allclose(found.sh[:, 1:4], gaussians.sh[:, 1:4], atol=0.03126)
    np.testing.assert_allclose(found.sh[:, 4:], gaussians.sh[:, 4:], atol=0.06251)
    largest = gaussians.scales.max(1) ** 2
    assert (np.abs(covariances(found) - covariances(gaussians)).max((1, 2)) < 0.09 * largest).all()
    quality = psnr(gaussians, found)
    print(f"degree {degree}: {quality:.1f} dB")
    assert quality > 36


def test_positions_of_an_spz_have_the_bits_that_the_furthest_leaves():
    for furthest, bits in ((0.3, 20), (7.9, 20), (8.0, 19), (100.0, 16), (8000.0, 10)):
        means = np.float32([[furthest, 0, 0], [-furthest, 0.1, 0]])
        assert position_bits(means) == bits
        gaussians = replace(head(2), means=means)
        np.testing.assert_allclose(read_spz(spz_bytes(gaussians))[0].means, means, atol=0.51 * 2.0**-bits)
    with pytest.raises(ArgumentError, match="spz: expected positions within 8 km, got 9000 m"):
        position_bits(np.float32([[0, -9000, 0]]))


def test_an_spz_is_the_same_every_time():
    assert spz_bytes(head(50)) == spz_bytes(head(50))


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_glb_loses_nothing(degree):
    gaussians = head(degree=degree)
    found, document = read_glb(glb_bytes(gaussians))
    np.testing.assert_array_equal(found.means, gaussians.means)
    np.testing.assert_array_equal(found.scales, gaussians.scales)
    np.testing.assert_array_equal(found.opacities, gaussians.opacities)
    np.testing.assert_allclose(found.sh, gaussians.sh, atol=1e-6)
    np.testing.assert_allclose(covariances(found), covariances(gaussians), atol=1e-9)
    assert psnr(gaussians, found) > 90
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    position = document["accessors"][0]
    np.testing.assert_allclose(position["min"], (gaussians.means * FLIP).min(0))
    np.testing.assert_allclose(position["max"], (gaussians.means * FLIP).max(0))


def test_what_knows_no_gaussians_sees_the_points_of_a_glb(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    gaussians = head(30)
    (tmp_path / "x.glb").write_bytes(glb_bytes(gaussians))
    scene = trimesh.load_scene(tmp_path / "x.glb")
    (points,) = scene.geometry.values()
    np.testing.assert_allclose(points.vertices, gaussians.means * FLIP)
    rgb = np.clip(0.5 + 0.2820948 * gaussians.sh[:, 0].astype(float), 0, 1)
    light = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    expected = np.column_stack([light, gaussians.opacities])
    np.testing.assert_allclose(points.visual.vertex_colors / 255, expected, atol=0.003)


READERS = {
    "ply": read_ply,
    "splat": read_splat,
    "spz": lambda d: read_spz(d)[0],
    "glb": lambda d: read_glb(d)[0],
}


@pytest.mark.parametrize("format", READERS)
def test_a_frame_of_an_avatar_is_what_the_player_poses(tiny, tmp_path, format):
    out = tmp_path / f"x.{format}"
    assert cli.main(["export", str(tiny), "--format", format, "--frame", "5", "-o", str(out)]) == 0
    avatar = cap4d.Avatar.load(tiny)
    expected = pose(avatar, avatar.idle.frame(5))
    found = READERS[format](out.read_bytes())
    assert len(found) == len(expected)
    places = [np.sort(g.means.astype(float) @ [1, 2, 4]) for g in (found, expected)]  # in any order
    np.testing.assert_allclose(*places, atol=1e-5)


def test_without_a_source_it_is_the_face_at_rest(tiny, tmp_path):
    export_file(tiny, tmp_path / "x.ply", format="ply")
    avatar = cap4d.Avatar.load(tiny)
    np.testing.assert_array_equal(
        read_ply((tmp_path / "x.ply").read_bytes()).means, pose(avatar, neutral(avatar)).means
    )


def test_a_clip_becomes_numbered_files(tiny, tmp_path):
    folder = tmp_path / "clip"
    written = export_file(tiny, folder, format="splat", frames="2:9:3")
    assert [p.name for p in written] == ["frame_00002.splat", "frame_00005.splat", "frame_00008.splat"]
    assert sorted(folder.iterdir()) == written
    avatar = cap4d.Avatar.load(tiny)
    np.savez(
        tmp_path / "drive.npz", expr=avatar.idle.expr, eye_rot=avatar.idle.eye_rot, rig_name=avatar.rig_name
    )
    written = export_file(tiny, tmp_path / "all", format="spz", drive=str(tmp_path / "drive.npz"))
    assert len(written) == len(avatar.idle)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--frame 12 -o x.ply", "frame: expected 0 to 11, got 12"),
        ("--frame -1 -o x.ply", "frame: expected 0 to 11, got -1"),
        ("--frames 3:3 -o x", "frames: expected some of the 12 frames, got 3:3"),
        ("--frames 1:2:0 -o x", "frames: expected some of the 12 frames, got 1:2:0"),
        ("--frames few -o x", "frames: expected all, FIRST:END or FIRST:END:STEP, got few"),
        ("--frames all -o tiny.cap4d", "output: expected a folder for the frames of a clip"),
        ("--frame 1 --frames all -o x", "frames: expected frame or frames, got both"),
        ("-o no/x.ply", "output: the folder of no/x.ply does not exist"),
        ("--frames all -o no/x", "output: the folder of no/x does not exist"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(tiny, capsys, words, line):
    assert cli.main(["export", "tiny.cap4d", "--format", "ply", *words.split()]) == 2
    assert line in capsys.readouterr().err
    assert [p.name for p in Path().iterdir()] == ["tiny.cap4d"]


def test_ranges():
    assert list(parse_range("all", 3)) == [0, 1, 2]
    assert list(parse_range(":2", 9)) == [0, 1]
    assert list(parse_range("7:", 9)) == [7, 8]
    assert list(parse_range("::4", 9)) == [0, 4, 8]
    assert list(parse_range("5:99", 7)) == [5, 6]


def test_an_interrupted_export_leaves_no_file(tmp_path, monkeypatch):
    def interrupted(self: Path, data: bytes) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_gaussians(head(5), tmp_path / "x.ply", "ply")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ArgumentError, match="format: expected ply, splat, spz, glb, got obj"):
        write_gaussians(head(5), tmp_path / "x.obj", "obj")


def test_every_degree_has_a_count():
    assert set(SH_COUNTS.values()) == {0, 1, 2, 3}
