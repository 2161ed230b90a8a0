"""GaussianAvatars' files become avatars that pose as FLAME's kinematic chain does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from cap4d.app.main import main as view
from gaussian_avatars_files import Invented, chained_vertices, invent, write_ply

from cap4d.bind import bind, triangle_frames
from cap4d.bundle import Bundle, read_bundle, read_manifest
from cap4d.cli import main
from cap4d.errors import ArgumentError, DataError
from cap4d.player.avatar import Avatar
from cap4d.raster.reference import eval_sh
from cap4d.rig.flame import FlameModel, read_flame
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.transfer.flame_teeth import N_TEETH, teeth_faces, with_teeth
from cap4d.transfer.gaussian_avatars import import_gaussian_avatars, read_edition, read_sequence
from cap4d.transfer.gaussian_ply import read_gaussian_ply

FLIP = np.float64([1, -1, -1])
VERTICES, FACES = 5023 + 120, 9976 + 168


@pytest.fixture(scope="module")
def pickle(shared: Path) -> Path:
    return shared / "flame" / "flame_standin.pkl"


@pytest.fixture(scope="module")
def flame(pickle: Path) -> FlameModel:
    return with_teeth(read_flame(pickle))


@pytest.fixture(scope="module")
def invented() -> Invented:
    return invent(faces=FACES, vertices=VERTICES)


@pytest.fixture(scope="module")
def imported(pickle: Path, invented: Invented, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gaussian_avatars")
    ply, params = invented.write(folder)
    import_gaussian_avatars(ply, folder / "a.cap4d", params=params, flame=pickle)
    return folder / "a.cap4d"


@pytest.fixture(scope="module")
def bundle(imported: Path) -> Bundle:
    return read_bundle(imported)


# The teeth ------------------------------------------------------------


def test_teeth_are_two_bars_open_at_their_roots() -> None:
    faces = teeth_faces()
    assert faces.shape == (168, 3) and set(faces.ravel()) == set(range(N_TEETH))
    pairs = [
        (int(a), int(b)) for a, b in np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ]
    assert len(pairs) == len(set(pairs))  # every side is wound alike
    rim = [pair for pair in pairs if pair[::-1] not in set(pairs)]
    assert len(rim) == 2 * (2 * 14 + 2 * 3)  # of each bar: two long rims, and three strips' ends twice


@pytest.mark.parametrize(
    ("number", "face"),
    [(0, (0, 31, 30)), (1, (0, 1, 31)), (13, (6, 7, 37)), (14, (7, 8, 37)), (15, (8, 38, 37)),
     (28, (60, 75, 76)), (43, (68, 82, 83)), (55, (74, 88, 89)), (56, (75, 30, 76)), (71, (82, 38, 83)),
     (83, (88, 44, 89)), (84, (45, 46, 15)), (98, (52, 23, 22)), (112, (90, 106, 105)),
     (127, (98, 113, 112)), (140, (105, 106, 45)), (154, (112, 53, 52)), (167, (118, 119, 59))],
)  # fmt: skip
def test_teeth_are_numbered_as_published(number: int, face: tuple[int, int, int]) -> None:
    assert tuple(teeth_faces()[number]) == face


def test_teeth_stand_behind_the_lips_and_move_with_head_and_jaw(flame: FlameModel) -> None:
    assert flame.template.shape == (VERTICES, 3) and flame.faces.shape == (FACES, 3)
    rows = flame.template[5023:].reshape(8, 15, 3)
    lip = flame.template[3543]
    assert (rows[..., 2].max(1) < lip[2]).all() and (rows[..., 0][:, 0] > 0).all()
    heights = rows[..., 1].mean(1)
    assert heights[0] > heights[2] > heights[3] > heights[1]
    assert flame.weights[5023:].sum(0).tolist() == [0, 60, 60, 0, 0]
    assert not flame.posedirs[5023:].any() and not flame.shapedirs[5023:, :, 300:].any()
    assert not flame.joint_regressor[:, 5023:].any() and flame.shapedirs[5023:, :, :300].any()


# Posing ------------------------------------------------------------


def world_from_head(
    bundle: Bundle, invented: Invented, flame: FlameModel, frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation from our head to FLAME's world, from vertices that the neck alone turns."""
    rigid = flame.weights[:, 1] == 1
    world = chained_vertices(flame, invented.params, frame)[rigid]
    head = posed(bundle, frame)[rigid]
    u, _, v = np.linalg.svd((world - world.mean(0)).T @ (head - head.mean(0)))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return rotation, world.mean(0) - rotation @ head.mean(0)


def posed(bundle: Bundle, frame: int) -> np.ndarray:
    """float64[V, 3] m, head frame, rig axes."""
    f = bundle.idle.frame(frame)
    turns = {"eye_rot": f.eye_rot, "neck_rot": f.neck_rot, "jaw_rot": f.jaw_rot}
    return Avatar(bundle).vertices(f.expr, **turns) * FLIP


@pytest.mark.parametrize("frame", range(5))
def test_gaussians_are_where_the_chain_puts_them(
    frame: int, bundle: Bundle, invented: Invented, flame: FlameModel
) -> None:
    """In FLAME's world, from the idle clip's own expression, joints and head pose; the file in between."""
    table = invented.table
    stack = lambda *names: np.stack([table[n] for n in names], -1).astype(np.float64)  # noqa: E731
    frames = triangle_frames(chained_vertices(flame, invented.params, frame), flame.faces)
    expected = bind(
        frames,
        means=stack("x", "y", "z"),
        quats=stack("rot_0", "rot_1", "rot_2", "rot_3"),
        log_scales=stack("scale_0", "scale_1", "scale_2"),
        binding=table["binding_0"].astype(int),
    )
    f = bundle.idle.frame(frame)
    found = Avatar(bundle).pose(f.expr, eye_rot=f.eye_rot, neck_rot=f.neck_rot, jaw_rot=f.jaw_rot)
    # The idle clip's world is FLAME's, turned and moved as a whole: the same for all frames.
    rotation, translation = world_from_head(bundle, invented, flame, 0)
    first = bundle.idle.frame(0)
    world = rotation @ axis_angle_to_rotmat(first.rot.astype(np.float64)).T
    origin = translation - world @ first.tra
    ours = (found.means * FLIP) @ axis_angle_to_rotmat(f.rot.astype(np.float64)).T + f.tra
    assert np.abs(ours @ world.T + origin - expected[0]).max() < 1e-5
    np.testing.assert_allclose(found.scales, expected[2], rtol=1e-3, atol=1e-7)


def test_two_eyes_that_differ_turn_by_their_mean(
    pickle: Path, invented: Invented, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    eyes = invented.params["eyes_pose"].copy()
    eyes[:, 3:] += np.float32([0, 0.1, 0])
    ply, params = replace(invented, params=invented.params | {"eyes_pose": eyes}).write(tmp_path)
    with caplog.at_level("INFO"):
        import_gaussian_avatars(ply, tmp_path / "a.cap4d", params=params, flame=pickle, fps=12.5)
    idle = read_bundle(tmp_path / "a.cap4d").idle
    np.testing.assert_allclose(idle.eye_rot, (eyes[:, :3] + eyes[:, 3:]) / 2, atol=1e-6)
    assert "up to 5.7 degrees apart" in caplog.text and idle.fps == 12.5


def test_the_file_is_an_avatar_on_the_rigs_own_triangles(
    imported: Path, bundle: Bundle, invented: Invented
) -> None:
    manifest = read_manifest(imported)
    assert manifest.version == 3 and manifest.rig_name == "flame_standin"
    assert (manifest.counts["rig_vertices"], manifest.counts["faces"]) == (VERTICES, FACES)
    assert bundle.n_expressions == 100 and bundle.tiers == ("off",)
    np.testing.assert_array_equal(bundle.idle.expr, invented.params["expr"])
    assert np.abs(bundle.idle.rot.mean(0)).max() < 0.05 and np.abs(bundle.idle.tra.mean(0)).max() < 1e-6
    picture = Avatar(bundle).draw(bundle.idle.frame(2), bundle.camera)
    assert (picture[..., 3] > 0).any(1).sum() > 100  # rows that the head fills


def test_harmonics_are_seen_from_the_mean_pose(bundle: Bundle, invented: Invented, flame: FlameModel) -> None:
    """A direction in FLAME's world gives the colour it gave there, where the head has its mean pose."""
    rotation, _ = world_from_head(bundle, invented, flame, 0)
    mean = rotation @ axis_angle_to_rotmat(bundle.idle.rot[0].astype(np.float64)).T
    world = np.tile([0.3, -0.5, 0.8], (len(bundle), 1))
    n = len(bundle)
    dc = np.stack([invented.table[f"f_dc_{i}"] for i in range(3)], -1)[:, None]
    rest = np.stack([invented.table[f"f_rest_{i}"] for i in range(45)], -1).reshape(n, 3, 15).swapaxes(1, 2)
    there = eval_sh(
        torch.from_numpy(np.concatenate([dc, rest], 1).astype(np.float64)), torch.from_numpy(world), 3
    )
    here = eval_sh(torch.from_numpy(bundle.sh.astype(np.float64)), torch.from_numpy(world @ mean * FLIP), 3)
    np.testing.assert_allclose(here.numpy(), there.numpy(), atol=1e-5)


def test_the_commands_import_and_play_it(
    pickle: Path, invented: Invented, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    ply, params = invented.write(tmp_path)
    files = [str(ply), "--flame", str(pickle)]
    avatar = tmp_path / "a.cap4d"
    assert main(["import", "gaussian-avatars", *files, "-o", str(avatar)]) == 0
    assert main(["inspect", str(avatar)]) == 0
    assert "the rig's own triangles, 5143 vertices, 10144 faces" in capsys.readouterr().out
    shot = tmp_path / "shot_%04d.png"
    line = f"{avatar} --headless --backend cpu --frames 2 --size 64x64 --out {shot}"
    assert view(line.split()) == 0
    assert len(list(tmp_path.glob("shot_*.png"))) == 2
    ply.write_bytes(ply.read_bytes()[:-1])
    assert main(["import", "gaussian-avatars", *files, "-o", str(tmp_path / "b.cap4d")]) == 1
    assert "data: expected" in capsys.readouterr().err and not (tmp_path / "b.cap4d").exists()
    params.unlink()
    assert main(["import", "gaussian-avatars", *files, "-o", str(tmp_path / "b.cap4d")]) == 1
    assert "flame_param.npz: file: expected an .npz archive, found no such file" in capsys.readouterr().err


# What is refused ------------------------------------------------------------


def cut(data: bytes) -> bytes:
    return data[:-1]


def swapped(old: str, new: str) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        assert old.encode() in data
        return data.replace(old.encode(), new.encode(), 1)

    return change


BROKEN = {
    "empty": (lambda d: b"", "header"),
    "cut": (cut, "data"),
    "longer": (lambda d: d + b"\0", "data"),
    "cut_header": (lambda d: d[:200], "header"),
    "no_end": (lambda d: b"ply\n" + b"comment x\n" * 7000, "header"),
    "one_long_line": (lambda d: b"ply" + b" " * (1 << 17), "header"),
    "another_file": (swapped("ply\n", "plx\n"), "header line 1"),
    "text": (swapped("binary_little_endian", "ascii"), "header line 2"),
    "big_endian": (swapped("little", "big"), "header line 2"),
    "list": (swapped("property float nx", "property list uchar int nx"), "header"),
    "unknown_type": (swapped("property float nx", "property quad nx"), "header"),
    "second_element": (swapped("property float nx", "element face 3"), "header"),
    "property_twice": (swapped("float nx", "float ny"), "header"),
    "no_vertices": (swapped("element vertex 40", "element vertex 0"), "element"),
    "negative": (swapped("element vertex 40", "element vertex -1"), "element"),
    "billions": (swapped("element vertex 40", "element vertex 9999999999999"), "element"),
    "too_many": (swapped("element vertex 40", "element vertex 4194305"), "element"),
    "more_than_there_are": (swapped("element vertex 40", "element vertex 41"), "data"),
    "another_element": (swapped("element vertex 40", "element point 40"), "element"),
    "missing": (swapped("float opacity", "float opacitx"), "opacity"),
    "unbound": (swapped("float binding_0", "float binding_1"), "binding_0"),
    "harmonics": (swapped("float f_rest_8", "float f_resx_8"), "f_rest_*"),
    "harmonics_numbered": (swapped("float f_rest_8", "float f_rest_9"), "f_rest_8"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_gaussians_are_refused(name: str, tmp_path: Path) -> None:
    change, field = BROKEN[name]
    ply, _ = invent(faces=50, vertices=5, gaussians=40, degree=1).write(tmp_path)
    read_gaussian_ply(ply, faces=50)
    ply.write_bytes(change(ply.read_bytes()))
    refused(lambda: read_gaussian_ply(ply, faces=50), field)


@pytest.mark.parametrize(
    ("name", "value", "field"),
    [
        ("x", np.nan, "x"),
        ("opacity", -np.inf, "opacity"),
        ("f_dc_1", 1e30, "f_dc_*, f_rest_*"),
        ("scale_2", 50, "scale_0 to scale_2"),
        ("binding_0", 50, "binding_0"),
        ("binding_0", -1, "binding_0"),
        ("binding_0", 0.5, "binding_0"),
        ("binding_0", np.nan, "binding_0"),
    ],
)
def test_numbers_that_make_no_gaussian_are_refused(
    name: str, value: float, field: str, tmp_path: Path
) -> None:
    table = invent(faces=50, vertices=5, gaussians=40).table
    table[name][3] = value
    write_ply(tmp_path / "a.ply", table)
    refused(lambda: read_gaussian_ply(tmp_path / "a.ply", faces=50), field)


def test_a_gaussian_without_direction_is_refused(tmp_path: Path) -> None:
    table = invent(faces=50, vertices=5, gaussians=40).table
    for i in range(4):
        table[f"rot_{i}"][7] = 0
    write_ply(tmp_path / "a.ply", table)
    refused(lambda: read_gaussian_ply(tmp_path / "a.ply", faces=50), "rot_0 to rot_3")


def test_bindings_may_be_of_any_type(tmp_path: Path) -> None:
    table = invent(faces=50, vertices=5, gaussians=40, degree=0).table
    typed = table.astype([(n, "<i4" if n == "binding_0" else "<f4") for n in table.dtype.names])
    write_ply(tmp_path / "a.ply", typed)
    path = tmp_path / "a.ply"
    path.write_bytes(path.read_bytes().replace(b"float binding_0", b"int binding_0"))
    found = read_gaussian_ply(path, faces=50)
    np.testing.assert_array_equal(found.binding, table["binding_0"])
    assert found.sh.shape == (40, 1, 3)


PARAMS = {
    "shape": (np.zeros(150, np.float32), "shape"),
    "expr": (np.zeros((5, 50), np.float32), "expr"),
    "eyes_pose": (np.zeros((5, 3), np.float32), "eyes_pose"),
    "jaw_pose": (np.zeros((4, 3), np.float32), "jaw_pose"),
    "neck_pose": (np.full((5, 3), np.nan, np.float32), "neck_pose"),
    "rotation": (np.full((5, 3), 1e6, np.float32), "rotation"),
    "translation": (np.full((5, 3), 501.0, np.float32), "translation"),
    "static_offset": (np.full((VERTICES, 3), 2.0, np.float32), "static_offset"),
    "static_offset_rows": (np.zeros((5000, 3), np.float32), "static_offset"),
    "static_offset_number": (np.float32(0), "static_offset"),
    "dynamic_offset": (np.full((5, VERTICES, 3), 1e-4, np.float32), "dynamic_offset"),
    "expr_number": (np.float32(0), "expr"),
    "expr_empty": (np.zeros((0, 100), np.float32), "expr"),
    "expr_objects": (np.array([{}], object), "expr"),
}


@pytest.mark.parametrize("name", PARAMS)
def test_parameters_that_are_none_are_refused(name: str, invented: Invented, tmp_path: Path) -> None:
    value, field = PARAMS[name]
    key = next(k for k in invented.params if name.startswith(k))
    path = tmp_path / "flame_param.npz"
    np.savez(path, **(invented.params | {key: value}))
    refused(lambda: read_sequence(path, vertices=VERTICES), field)


@pytest.mark.parametrize("rows", [5023, VERTICES, None])
def test_static_offsets_know_teeth_or_not(rows: int | None, invented: Invented, tmp_path: Path) -> None:
    path, params = tmp_path / "flame_param.npz", dict(invented.params)
    offset = params.pop("static_offset")
    if rows is not None:
        params["static_offset"] = offset[None, :rows]  # a batch of one, as trackers write it
    params.pop("dynamic_offset")
    np.savez(path, **params)
    found = read_sequence(path, vertices=VERTICES).static_offset
    expected = np.zeros_like(offset) if rows is None else offset * (np.arange(VERTICES) < rows)[:, None]
    np.testing.assert_array_equal(found, expected.astype(np.float64))


def test_the_edition_without_a_jaw_is_refused(tmp_path: Path) -> None:
    refused(lambda: read_edition(tmp_path / "flame2023_no_jaw.pkl"), "model")


def test_an_impossible_rate_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"fps: expected 0\.1 to 1000"):
        import_gaussian_avatars(tmp_path, tmp_path / "a", params=tmp_path, flame=tmp_path, fps=0)


def refused(read: Callable[[], object], field: str) -> None:
    with pytest.raises(DataError) as caught:
        read()
    assert caught.value.field == field and "\n" not in str(caught.value)
