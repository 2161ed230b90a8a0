"""Rigs on disk: what is written is what is read, and each kind of damage is refused in one line."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from cap4d.errors import ArgumentError, DataError
from cap4d.rig.head import HeadRig, MouthPlacement
from cap4d.rig.store import load_rig, save_rig


@pytest.fixture
def rig() -> HeadRig:
    """A tetrahedron with two identity modes, two expressions and three joints."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return HeadRig(
        name="tetrahedron",
        licence="CC0-1.0",
        template=normal(4, 3),
        faces=np.int32([[0, 1, 2], [0, 3, 1]]),
        uvs=rng.uniform(size=(5, 2)).astype(np.float32),
        uv_faces=np.int32([[0, 1, 2], [0, 4, 1]]),
        identity_basis=normal(2, 4, 3),
        expression_basis=normal(2, 4, 3),
        expression_names=("jawOpen", "blink"),
        expression_range=np.float32([[0, 1], [-1, 1]]),
        joint_names=("neck", "eye", "mouth"),
        joint_drivers=("neck", "eyes", "expr"),
        joints=normal(3, 3),
        joints_identity=normal(2, 3, 3),
        joints_expression=normal(2, 3, 3),
        skin_weights=np.float32([[1, 0, 0], [0, 1, 0], [0.2, 0.3, 0.1], [0, 0, 0]]),
        expr_rotation=normal(2, 3),
        pose_basis=normal(27, 4, 3),
        pose_offset=normal(4, 3),
        mouth=MouthPlacement(np.abs(normal(4, 4)), normal(2, 3), normal(2, 2, 3)),
        colors=rng.uniform(size=(4, 3)).astype(np.float32),
        regions={"head": np.int32([0, 1]), "deformable": np.int32([0]), "landmarks": np.int32([3, 1])},
    )


def test_round_trip(rig, tmp_path):
    save_rig(rig, tmp_path / "rig.npz")
    loaded = load_rig(tmp_path / "rig.npz")
    for f in fields(HeadRig):
        if f.name not in ("mouth", "regions"):
            np.testing.assert_array_equal(getattr(loaded, f.name), getattr(rig, f.name), err_msg=f.name)
    for f in fields(MouthPlacement):
        np.testing.assert_array_equal(
            getattr(loaded.mouth, f.name), getattr(rig.mouth, f.name), err_msg=f.name
        )
    assert loaded.regions.keys() == rig.regions.keys()
    np.testing.assert_array_equal(loaded.regions["landmarks"], [3, 1])  # the order is kept
    assert [p.name for p in tmp_path.iterdir()] == ["rig.npz"]


def test_optional_parts_stay_absent(rig, tmp_path):
    absent = {"pose_basis": None, "pose_offset": None, "mouth": None, "colors": None}
    save_rig(replace(rig, **absent), tmp_path / "rig.npz")
    loaded = load_rig(tmp_path / "rig.npz")
    assert [getattr(loaded, name) for name in absent] == [None] * 4


def test_same_rig_same_bytes(rig, tmp_path):
    save_rig(rig, tmp_path / "a.npz")
    save_rig(rig, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_save_into_a_missing_folder(rig, tmp_path):
    with pytest.raises(ArgumentError, match="folder does not exist"):
        save_rig(rig, tmp_path / "missing" / "rig.npz")


DAMAGE = {
    "format": (np.array("cap4d-rig 99"), "format: expected cap4d-rig 1, found cap4d-rig 99"),
    "template": (np.zeros((4, 2), np.float32), r"template: expected float\[\*, 3\], found float32\[4, 2\]"),
    "expression_basis": (np.full((2, 4, 3), np.nan, np.float32), "expression_basis: expected finite values"),
    "identity_basis": (np.zeros((2, 5, 3), np.float32), r"identity_basis: expected float\[\*, 4, 3\]"),
    "pose_basis": (np.zeros((18, 4, 3), np.float32), r"pose_basis: expected float\[27, 4, 3\]"),
    "faces": (np.int32([[0, 1, 4], [0, 1, 2]]), "faces: expected indices 0 to 3, found 4"),
    "uv_faces": (np.int32([[0, 1, -1], [0, 1, 2]]), "uv_faces: expected indices 0 to 4, found -1"),
    "regions/head": (np.int32([9]), "regions/head: expected indices 0 to 3, found 9"),
    "joint_drivers": (np.array(["neck", "eyes", "tail"]), "joint_drivers: expected neck or .*, found tail"),
    "expression_names": (np.array(["a", "a"]), "expression_names: expected different names"),
    "skin_weights": (np.ones((4, 3), np.float32), "skin_weights: expected at least 0, at most 1 in sum"),
    "expression_range": (np.float32([[1, 0], [0, 1]]), "expression_range: expected low, high"),
    "uvs": (np.full((5, 2), 2, np.float32), "uvs: expected 0 to 1, found 2 to 2"),
    "name": (np.zeros(3), r"name: expected text\[\], found float64\[3\]"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_array(rig, tmp_path, name):
    path = tmp_path / "rig.npz"
    save_rig(rig, path)
    array, message = DAMAGE[name]
    with np.load(path) as arrays:
        np.savez(path, **{**arrays, name: array})
    with pytest.raises(DataError, match=message) as caught:
        load_rig(path)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    "name", ["template", "skin_weights", "licence", "regions/deformable", "mouth/anchors"]
)
def test_missing_array(rig, tmp_path, name):
    path = tmp_path / "rig.npz"
    save_rig(rig, path)
    with np.load(path) as arrays:
        np.savez(path, **{key: value for key, value in arrays.items() if key != name})
    with pytest.raises(DataError, match=name.split("/")[-1]):
        load_rig(path)


def test_objects_are_refused(rig, tmp_path):
    path = tmp_path / "rig.npz"
    save_rig(rig, path)
    with np.load(path) as arrays:
        np.savez(path, **{**arrays, "template": np.array([{}], object)})
    with pytest.raises(DataError, match="template: expected plain numbers or text, found dtype object"):
        load_rig(path)


def test_truncated_and_foreign_files(rig, tmp_path):
    path = tmp_path / "rig.npz"
    save_rig(rig, path)
    data = path.read_bytes()
    for content in (data[: len(data) // 2], b"", b"not a zip"):
        path.write_bytes(content)
        with pytest.raises(DataError):
            load_rig(path)
    with pytest.raises(DataError, match="no such file"):
        load_rig(tmp_path / "none.npz")


def test_flipped_bit_is_noticed(rig, tmp_path):
    path = tmp_path / "rig.npz"
    save_rig(rig, path)
    data = bytearray(path.read_bytes())
    at = data.find(rig.template.tobytes())
    data[at + 5] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match="CRC"):
        load_rig(path)


def test_header_that_promises_more_than_there_is(rig, tmp_path):
    path = tmp_path / "rig.npz"
    save_rig(rig, path)
    import zipfile

    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["template.npy"] = members["template.npy"].replace(b"(4, 3), }", b"(4000000000, 3), }")
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(DataError, match="template: expected 48000000000 bytes"):
        load_rig(path)
