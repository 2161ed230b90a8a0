"""Hostile .npz and .npy files: headers that lie, text that is none, bombs, and what no one asked for."""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from cap4d.errors import DataError
from cap4d.rig.npz import checked_float32, read_npy, read_npz


def npy(descr: str, shape: str, data: bytes = b"") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


HEADERS = {
    "empty_text": npy("'<U0'", "(3,)"),
    "empty_void": npy("'|V0'", "(3,)"),
    "void": npy("'|V4'", "(1,)", bytes(4)),
    "bytes": npy("'|S4'", "(1,)", bytes(4)),
    "complex": npy("'<c8'", "(1,)", bytes(8)),
    "times": npy("'<M8[s]'", "(1,)", bytes(8)),
    "objects": npy("'|O'", "(1,)", bytes(8)),
    "records": npy("[('a', '<f4')]", "(1,)", bytes(4)),
    "arrays_of_arrays": npy("('<f4', (2,))", "(1,)", bytes(8)),
    "nothing_of_vast_size": npy("'<f4'", "(0, 1000000000000000000000)"),
    "nothing_of_large_sizes": npy("'<f4'", "(0, 4294967296, 4294967296, 4294967296)"),
    "flags_as_sizes": npy("'<f4'", "(True, 0)"),
    "fraction": npy("'<f4'", "(0.5,)"),
    "negative": npy("'<f4'", "(-1, -1)", bytes(4)),
    "too_many_dimensions": npy("'<f4'", str((1,) * 100), bytes(4)),
    "short": npy("'<f4'", "(2,)", bytes(4)),
    "long": npy("'<f4'", "(1,)", bytes(8)),
    "no_character": npy("'<U1'", "(1,)", b"\xff\xff\xff\xff"),
    "no_character_big_endian": npy("'>U1'", "(1,)", b"\x00\x11\x00\x00"),
    "half_a_character": npy("'<U1'", "(1,)", b"\x00\xd8\x00\x00"),
    "version_3": npy("'<f4'", "(0,)").replace(b"\x01\x00", b"\x03\x00", 1),
    "no_header": b"hello",
    "nothing": b"",
}


@pytest.mark.parametrize("name", HEADERS)
def test_hostile_headers_are_refused_by_name(name: str, tmp_path: Path) -> None:
    archive, single = tmp_path / "a.npz", tmp_path / "a.npy"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("member.npy", HEADERS[name])
    single.write_bytes(HEADERS[name])
    for path, read, field in ((archive, read_npz, "member"), (single, read_npy, "array")):
        with pytest.raises(DataError) as caught:
            read(path)
        assert (caught.value.source, caught.value.field) == (str(path), field)
        assert "\n" not in str(caught.value) and caught.value.found


def test_text_of_any_byte_order_is_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.array(["Zoë", "\U0001f600"]), b=np.array("b").astype(">U3"))
    arrays = read_npz(tmp_path / "a.npz")
    assert arrays["a"].tolist() == ["Zoë", "\U0001f600"] and str(arrays["b"]) == "b"


def test_layouts_are_kept(tmp_path: Path) -> None:
    value = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.savez_compressed(tmp_path / "a.npz", f=value, none=np.zeros((0, 3), np.float32), one=np.float64(2))
    arrays = read_npz(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["f"], value)
    assert arrays["none"].shape == (0, 3) and arrays["one"].shape == () and arrays["one"] == 2


def test_only_what_is_asked_for_is_unpacked_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, wanted=np.arange(3), vast=np.zeros(100_000), evil=np.array([{}], object))
    assert list(read_npz(path, names={"wanted", "absent"}, max_bytes=1000)) == ["wanted"]
    with pytest.raises(DataError, match="size: expected at most 1000 bytes unpacked"):
        read_npz(path, names={"wanted", "vast"}, max_bytes=1000)
    np.save(tmp_path / "a.npy", np.zeros(1000))
    with pytest.raises(DataError, match="size: expected at most 1000 bytes"):
        read_npy(tmp_path / "a.npy", max_bytes=1000)


def test_data_that_do_not_inflate_are_refused(tmp_path: Path) -> None:
    path, data = tmp_path / "a.npz", np.random.default_rng(0).integers(0, 4, 10_000)
    np.savez_compressed(path, a=data)
    damaged = bytearray(path.read_bytes())
    damaged[200:230] = bytes(255 - b for b in damaged[200:230])
    path.write_bytes(damaged)
    with zipfile.ZipFile(path) as archive, pytest.raises((zlib.error, zipfile.BadZipFile)):
        archive.read("a.npy")
    with pytest.raises(DataError, match="a: expected a plain array"):
        read_npz(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_what_numpy_never_writes_is_refused(method: int, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("a.npy", npy("'<f4'", "(1,)", bytes(4)))
    with pytest.raises(DataError, match="a: expected stored or deflated"):
        read_npz(tmp_path / "a.npz")


def test_numbers_beyond_float32_are_refused() -> None:
    assert checked_float32(Path("x"), "n", np.array([1, 2]), shape=(2,)).dtype == np.float32
    assert checked_float32(Path("x"), "n", np.float64(3), shape=()).shape == ()
    for bad in (np.array([1e300]), np.array([np.nan]), np.array(["1"]), np.array([True]), None):
        with pytest.raises(DataError, match="x: n: expected"):
            checked_float32(Path("x"), "n", bad, shape=(1,))
