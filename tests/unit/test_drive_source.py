"""Every source that `--drive` names: what it gives, and each way in which it can be malformed."""

from __future__ import annotations

import logging
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.clip import Clip
from cap4d.drive.sample import sample
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError, DataError

T, E = 6, len(EXPRESSIONS)


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return tiny_bundle(8, network=False)


@pytest.fixture(scope="module")
def flame() -> Bundle:
    """The tiny bundle under FLAME's name and with FLAME's number of expressions."""
    tiny = tiny_bundle(8, network=False)
    subject = replace(
        tiny.subject,
        rig_name="flame2023_no_jaw",
        expression_names=tuple(f"e{i}" for i in range(65)),
        expression_basis=np.zeros((65, *tiny.subject.neutral.shape), np.float32),
    )
    return replace(tiny, subject=subject, mesh_subject=None)


def fit(path: Path, **changes: object) -> str:
    """A fit.npz for the tiny rig; None takes a key out."""
    rng = np.random.default_rng(0)
    arrays = {name: 0.1 * rng.normal(size=(T, 3)).astype(np.float32) for name in ("eye_rot", "rot", "tra")}
    arrays |= {"expr": rng.normal(size=(T, E)).astype(np.float32), "fps": np.array(25)}
    arrays |= {"rig_name": np.array(RIG_NAME), "shape": np.zeros(150, np.float32)}
    arrays |= changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return str(path)


def refused(spec: str, bundle: Bundle, **options: object) -> DataError:
    with pytest.raises(DataError) as caught:
        open_source(spec, bundle, **options)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600
    return caught.value


def test_no_source_is_the_idle_clip(bundle: Bundle) -> None:
    assert open_source(None, bundle) is bundle.idle
    assert open_source(None, bundle, fps=12).fps == 12


def test_a_template_goes_with_vertices_only(bundle: Bundle, tmp_path: Path) -> None:
    for spec in (None, fit(tmp_path / "fit.npz")):
        with pytest.raises(ArgumentError, match="template"):
            open_source(spec, bundle, template=tmp_path / "neutral.npy")


@pytest.mark.parametrize("spec", ["a.txt", "webcam://0", "-", "clip"])
def test_other_sources_are_argument_errors(spec: str, bundle: Bundle) -> None:
    with pytest.raises(ArgumentError, match="drive: expected"):
        open_source(spec, bundle)


@pytest.mark.parametrize("fps", [0, -1, float("nan"), 1e9])
def test_a_senseless_rate_is_an_argument_error(fps: float, bundle: Bundle) -> None:
    with pytest.raises(ArgumentError, match="fps"):
        open_source(None, bundle, fps=fps)


# fit.npz


def test_a_fit_gives_everything_it_has(bundle: Bundle, tmp_path: Path) -> None:
    spec = fit(tmp_path / "fit.npz", neck_rot=np.full((T, 3), 0.25))
    clip, stored = open_source(spec, bundle), np.load(spec)
    assert (clip.rig_name, clip.fps, len(clip)) == (RIG_NAME, 25, T)
    for name in ("expr", "eye_rot", "rot", "tra", "neck_rot"):
        assert np.array_equal(getattr(clip, name), stored[name]) and getattr(clip, name).dtype == np.float32
    assert not clip.jaw_rot.any()
    assert open_source(spec, bundle, fps=50).fps == 50


def test_a_fit_without_pose_or_rate(bundle: Bundle, tmp_path: Path) -> None:
    clip = open_source(fit(tmp_path / "fit.npz", rot=None, tra=None, fps=None), bundle)
    assert clip.rot is None and clip.tra is None and clip.fps == 24


def test_a_released_fit_names_no_rig_and_means_flame(flame: Bundle, bundle: Bundle, tmp_path: Path) -> None:
    spec = fit(tmp_path / "fit.npz", rig_name=None, expr=np.ones((T, 65), np.float32))
    assert open_source(spec, flame).expr.shape == (T, 65)
    error = refused(spec, bundle)
    assert error.field == "rig_name" and "flame2023_no_jaw" in error.found and "tiny" in error.expected


def broken_archive(path: Path) -> str:
    fit(path)
    path.write_bytes(path.read_bytes()[:-30])
    return str(path)


def bomb(path: Path) -> str:
    """An archive whose directory promises 512 MiB of zeros and a byte."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("expr.npy", bytes(1000))
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02")
    data[at + 24 : at + 28] = ((1 << 29) + 1).to_bytes(4, "little")
    path.write_bytes(data)
    return str(path)


def pickled(path: Path) -> str:
    np.savez(path, expr=np.array([{"a": 1}], object), eye_rot=np.zeros((1, 3)))
    return str(path)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (str, "file"),
        (lambda p: str(p) if p.write_bytes(b"not a zip") else "", "archive"),
        (broken_archive, "archive"),
        (bomb, "size"),
        (pickled, "expr"),
        (lambda p: fit(p, expr=None), "expr"),
        (lambda p: fit(p, expr=np.zeros((T, E + 1))), "expr"),
        (lambda p: fit(p, expr=np.zeros(E)), "expr"),
        (lambda p: fit(p, expr=np.zeros((0, E)), eye_rot=np.zeros((0, 3))), "expr"),
        (lambda p: fit(p, expr=np.full((T, E), np.nan)), "expr"),
        (lambda p: fit(p, expr=np.full((T, E), "x")), "expr"),
        (lambda p: fit(p, eye_rot=None), "eye_rot"),
        (lambda p: fit(p, eye_rot=np.zeros((T + 1, 3))), "eye_rot"),
        (lambda p: fit(p, rot=np.full((T, 3), np.inf)), "rot"),
        (lambda p: fit(p, neck_rot=np.zeros((T, 4))), "neck_rot"),
        (lambda p: fit(p, fps=np.array(0)), "fps"),
        (lambda p: fit(p, fps=np.array([1, 2])), "fps"),
        (lambda p: fit(p, fps=np.array("25")), "fps"),
        (lambda p: fit(p, rig_name=np.array("ict_facekit_light")), "rig_name"),
        (lambda p: fit(p, rig_name=np.array(["tiny", "tiny"])), "rig_name"),
        (lambda p: fit(p, rig_name=np.array(3)), "rig_name"),
    ],
)
def test_malformed_fits_are_refused(make, field: str, bundle: Bundle, tmp_path: Path) -> None:
    spec = make(tmp_path / "fit.npz")
    error = refused(spec, bundle)
    assert error.field == field and error.source == spec


def test_damaged_fits_raise_nothing_but_data_errors(bundle: Bundle, tmp_path: Path) -> None:
    path = tmp_path / "fit.npz"
    data, rng, refusals = Path(fit(path)).read_bytes(), np.random.default_rng(5), 0
    for _ in range(300):
        changed, where = bytearray(data), int(rng.integers(len(data)))
        if rng.random() < 0.7:
            changed[where] ^= 1 << int(rng.integers(8))
        else:
            del changed[where:]
        path.write_bytes(bytes(changed))
        try:
            assert np.isfinite(open_source(str(path), bundle).expr).all()
        except DataError:
            refusals += 1
    assert refusals > 150  # a third of the bytes are of arrays that are not read


# Vertices


def mesh_sequence(bundle: Bundle, expr: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [T, V, 3] of the bundle's own mesh and its neutral ones, joints left aside."""
    mesh = bundle.mesh_subject
    return mesh.neutral + np.tensordot(expr, mesh.expression_basis, 1).astype(np.float32), mesh.neutral


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("suffix", [".npy", ".npz", ".obj"])
def test_vertices_with_a_template(flat: bool, suffix: str, bundle: Bundle, tmp_path: Path) -> None:
    expr = np.random.default_rng(2).normal(size=(T, E)).astype(np.float32)
    vertices, template = mesh_sequence(bundle, expr)
    np.save(tmp_path / "v.npy", vertices.reshape(T, -1) if flat else vertices)
    path = tmp_path / f"template{suffix}"
    if suffix == ".npy":
        np.save(path, template)
    elif suffix == ".npz":
        np.savez(path, template=template)
    else:
        path.write_text(
            "# head\n" + "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in template.tolist()) + "f 1 2 3\n"
        )
    clip = open_source(str(tmp_path / "v.npy"), bundle, template=path, fps=60)
    assert (clip.fps, clip.rot) == (60, None)
    np.testing.assert_allclose(clip.expr, expr, atol=0.02)


def test_without_a_template_the_first_frame_is_neutral(
    bundle: Bundle, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    expr = np.random.default_rng(2).normal(size=(T, E)).astype(np.float32)
    np.save(tmp_path / "v.npy", mesh_sequence(bundle, expr)[0])
    with caplog.at_level(logging.INFO):
        clip = open_source(str(tmp_path / "v.npy"), bundle)
    assert clip.fps == 30
    np.testing.assert_allclose(clip.expr, expr - expr[0], atol=0.02)
    assert (
        "first frame is taken for the neutral face" in caplog.text and "mm of motion left over" in caplog.text
    )


V = 64  # vertices of the tiny mesh


@pytest.mark.parametrize(
    ("array", "found"),
    [
        (np.zeros((T, 3 * V + 3), np.float32), "195"),
        (np.zeros((T, 70110), np.float32), "BIWI"),
        (np.zeros((T, V, 2), np.float32), "64, 2"),
        (np.zeros((T, 2 * V, 3), np.float32), "128, 3"),
        (np.zeros(3 * V, np.float32), "192"),
        (np.zeros((0, 3 * V), np.float32), "0"),
        (np.zeros((T, 3 * V), np.int32), "int32"),
        (np.full((T, 3 * V), np.nan, np.float32), "not"),
        (np.full((T, 3 * V), -np.inf), "not"),
        (np.array([["x"] * 3 * V]), "<U1"),
    ],
)
def test_malformed_vertices_are_refused(
    array: np.ndarray, found: str, bundle: Bundle, tmp_path: Path
) -> None:
    np.save(tmp_path / "v.npy", array)
    error = refused(str(tmp_path / "v.npy"), bundle)
    assert error.field == "vertices" and found in error.found


@pytest.mark.parametrize(
    "data",
    [b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00\x0a\x00{'descr': 1", b"\x93NUMPY\x01\x00v\x00" + b"(" * 118],
)
def test_broken_npy_files_are_refused(data: bytes, bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "v.npy").write_bytes(data)
    refused(str(tmp_path / "v.npy"), bundle)


def test_a_pickle_in_an_npy_is_refused(bundle: Bundle, tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.array([{"a": 1}], object))
    assert "object" in refused(str(tmp_path / "v.npy"), bundle).found


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("t.npy", lambda p: np.save(p, np.zeros((V, 2)))),
        ("t.npy", lambda p: np.save(p, np.full((V, 3), np.nan))),
        ("t.npz", lambda p: np.savez(p, other=np.zeros((V, 3)))),
        ("t.obj", lambda p: p.write_text("v 1 2 3\n")),
        ("t.obj", lambda p: p.write_text("v 1 2\n" * V)),
        ("t.obj", lambda p: p.write_text("v a b c\n" * V)),
        ("t.obj", lambda p: p.write_text("v nan 0 0\n" * V)),
        ("t.obj", lambda p: None),
    ],
)
def test_malformed_templates_are_refused(name: str, write, bundle: Bundle, tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.zeros((T, 3 * V), np.float32))
    write(tmp_path / name)
    error = refused(str(tmp_path / "v.npy"), bundle, template=tmp_path / name)
    assert error.source == str(tmp_path / name)


def test_another_kind_of_template_is_an_argument_error(bundle: Bundle, tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.zeros((T, 3 * V), np.float32))
    with pytest.raises(ArgumentError, match="template: expected one of"):
        open_source(str(tmp_path / "v.npy"), bundle, template=tmp_path / "t.stl")


# Between frames


def ramp() -> Clip:
    rows = np.arange(4, dtype=np.float32)[:, None]
    turn = np.float32([[0, 0, 0], [0.2, 0, 0], [2.5, 0, 0], [2.5, 0, 0]])
    return Clip("r", 10.0, rows * np.float32([1, -1]), turn, 0 * turn, 0 * turn, turn, turn)


@pytest.mark.parametrize(
    ("t", "expected"),
    [(0.0, 0), (0.05, 0.5), (0.1, 1), (0.125, 1.25), (0.3, 3), (0.35, 3), (0.4, 0), (1.0, 2), (3 / 10, 3)],
)
def test_sampling_is_linear_and_starts_again(t: float, expected: float) -> None:
    frame = sample(ramp(), t)
    np.testing.assert_allclose(frame.expr, [expected, -expected], atol=1e-5)
    assert frame.t == t and frame.rig_name == "r" and frame.expr.dtype == np.float32


def test_a_cut_stays_a_cut() -> None:
    clip = ramp()
    assert sample(clip, 0.05).rot[0] == pytest.approx(0.1)
    assert sample(clip, 0.14).rot[0] == pytest.approx(0.2) and sample(clip, 0.16).rot[0] == pytest.approx(2.5)
    assert sample(clip, 0.14).tra[0] == pytest.approx(0.2 + 0.4 * 2.3, abs=1e-5), "places are not turns"
    assert sample(replace(clip, rot=None, tra=None), 0.05).rot is None
