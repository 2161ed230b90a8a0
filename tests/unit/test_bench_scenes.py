"""Scenes from files, which may be anything, and the package's own."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from cap4d.errors import ArgumentError, DataError
from cap4d.evaluate.bench.scenes import NAMES, SceneSource, check_folder, gaussian_count, read_scene
from cap4d.evaluate.bench.synthetic import STANDARD, fog_scene, front_camera, head_scene
from cap4d.evaluate.bench.work import count_work

COUNT = 7


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"means": (COUNT, 3), "quats": (COUNT, 4), "scales": (COUNT, 3), "opacities": (COUNT,)}
    return {name: rng.random(shape).astype(np.float32) for name, shape in shapes.items()} | {
        "sh": rng.random((COUNT, 16, 3)).astype(np.float32)
    }


def cameras() -> dict:
    rest = {"width": 64, "height": 48, "fx": 80.0, "fy": 81, "cx": 32.0, "cy": 24.0}
    return {**rest, "viewmats": [np.eye(4).tolist(), (2 * np.eye(4)).tolist()]}


def write(folder: Path, scene: dict | None = None, views: object = None) -> Path:
    for name in NAMES:
        np.savez(folder / f"{name}.npz", **(arrays() if scene is None else scene))
    (folder / "cameras.json").write_text(json.dumps(cameras() if views is None else views))
    return folder


def test_a_folder_of_scenes_is_read_as_it_stands(tmp_path: Path) -> None:
    source = check_folder(write(tmp_path))
    scene = source.load("head_100k")
    assert np.array_equal(scene.gaussians.sh, arrays()["sh"])
    assert (scene.camera.width, scene.camera.height, scene.camera.K[1, 1]) == (64, 48, 81)
    assert np.array_equal(scene.camera.viewmat, np.eye(4))
    assert scene.with_sh_degree(1).gaussians.sh.shape == (COUNT, 4, 3)
    assert scene.resized(32).view[2:] == (32, 32)


@pytest.mark.parametrize("name", ["means", "sh", "opacities"])
@pytest.mark.parametrize("how", ["gone", "short", "not finite", "text"])
def test_bad_arrays_are_refused_by_name(tmp_path: Path, name: str, how: str) -> None:
    scene = arrays()
    bad = {
        "short": scene[name][:3] if name != "means" else scene[name][:, :2],
        "not finite": np.full_like(scene[name], np.inf),
        "text": np.full(scene[name].shape, "x"),
    }
    if how == "gone":
        del scene[name]
    else:
        scene[name] = bad[how]
    with pytest.raises(DataError, match=name):
        read_scene(write(tmp_path, scene), "head_30k")


def test_a_wrong_number_of_coefficients_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="sh: expected 1, 4, 9 or 16"):
        read_scene(write(tmp_path, arrays() | {"sh": np.zeros((COUNT, 5, 3), np.float32)}), "bad_30k")


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    write(tmp_path)
    np.savez(tmp_path / "head_30k.npz", **(arrays() | {"means": np.array([{}] * COUNT, object)}))
    with pytest.raises(DataError, match="means"):
        read_scene(tmp_path, "head_30k")
    (tmp_path / "head_30k.npz").write_bytes(pickle.dumps(arrays()))
    with pytest.raises(DataError, match="archive"):
        read_scene(tmp_path, "head_30k")


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"width": 0}, "size"),
        ({"width": 1e6}, "size"),
        ({"height": 48.5}, "size"),
        ({"fx": -1}, "fx"),
        ({"fx": "80"}, "fx"),
        ({"fy": True}, "fy"),
        ({"cx": float("nan")}, "cx"),
        ({"viewmats": []}, "viewmats"),
        ({"viewmats": None}, "viewmats"),
        ({"viewmats": {"0": 1}}, "viewmats"),
        ({"viewmats": [[[1, 2], [3]]]}, "viewmats"),
        ({"viewmats": [(2 * np.eye(4)).tolist()]}, "viewmats"),
    ],
)
def test_bad_cameras_are_refused_by_field(tmp_path: Path, change: dict, field: str) -> None:
    with pytest.raises(DataError, match=field):
        read_scene(write(tmp_path, views=cameras() | change), "head_30k")


@pytest.mark.parametrize("text", ["[1]", "{", "[" * 100_000, "\udcff"])
def test_cameras_that_are_no_object_are_refused(tmp_path: Path, text: str) -> None:
    write(tmp_path)
    (tmp_path / "cameras.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(DataError, match=r"cameras\.json"):
        read_scene(tmp_path, "head_30k")


def test_a_folder_that_lacks_something_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="expected a folder"):
        check_folder(tmp_path / "nothing")
    write(tmp_path)
    (tmp_path / "bad_100k.npz").unlink()
    with pytest.raises(DataError, match="bad_100k"):
        check_folder(tmp_path)


def test_own_scenes_are_the_same_each_time_and_as_large_as_they_say() -> None:
    for make in (head_scene, fog_scene):
        first, second = make(2_000), make(2_000)
        assert len(first) == 2_000 and first.sh_degree == 3
        assert all(np.array_equal(getattr(first, k), getattr(second, k)) for k in ("means", "quats", "sh"))
        assert not np.array_equal(first.means, make(2_000, seed=1).means)
        assert np.isfinite(first.sh).all() and (first.scales > 0).all()
        assert (first.opacities > 1 / 255).all() and (first.opacities < 1).all()
    assert gaussian_count("bad_30k") == 30_000
    assert len(SceneSource().load("bad_30k", count=50).gaussians) == 50


def test_the_own_head_is_as_much_work_as_the_standard_one() -> None:
    work, _ = count_work(head_scene(30_000), front_camera())
    for name, standard in STANDARD["head_30k"].items():
        assert getattr(work, name) == pytest.approx(standard, rel=0.05), name
