"""An avatar measured on a capture: the numbers, the report, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

for module in ("OpenImageIO", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle  # noqa: E402

from cap4d import cli  # noqa: E402
from cap4d.bundle import write_bundle  # noqa: E402
from cap4d.camera import Camera, head_fixed  # noqa: E402
from cap4d.capture.capture import Capture, save_capture  # noqa: E402
from cap4d.capture.image import read_image, write_image  # noqa: E402
from cap4d.errors import ArgumentError, DataError  # noqa: E402
from cap4d.evaluate.evaluate import evaluate  # noqa: E402
from cap4d.evaluate.views import parse_frames, runs, select_views  # noqa: E402
from cap4d.player.avatar import Avatar  # noqa: E402

PIXELS = ("PSNR", "SSIM", "PSNR-fg")
FRAMES, SIZE = 6, 48


def write_capture(
    path: Path, avatar: Avatar, *, noise: float = 0, mattes: bool = False, rig: str = RIG_NAME
) -> Path:
    """Two cameras' films of an avatar that moves its head: exactly what a player draws, plus noise."""
    rng = np.random.default_rng(0)
    frames = {
        "expr": rng.uniform(0, 1, (FRAMES, len(EXPRESSIONS))).astype(np.float32),
        "eye_rot": rng.normal(0, 0.2, (FRAMES, 3)).astype(np.float32),
        "neck_rot": rng.normal(0, 0.1, (FRAMES, 3)).astype(np.float32),
        "rot": rng.normal(0, 0.2, (FRAMES, 3)).astype(np.float32),
        "tra": rng.normal(0, 0.01, (FRAMES, 3)).astype(np.float32),
    }
    K = np.array([[90.0, 0, SIZE / 2], [0, 90.0, SIZE / 2], [0, 0, 1]])
    cameras = {}
    for name, x in (("left", -0.03), ("right", 0.03)):
        viewmat = np.eye(4)
        viewmat[:3, 3] = [x, 0, 0.5]
        cameras[name] = Camera(K, viewmat, SIZE, SIZE)
    held_out = np.arange(FRAMES) == 4
    save_capture(
        path, rig_name=rig, shape=np.zeros(3), cameras=cameras, fps=25.0, held_out=held_out, **frames
    )
    for name, camera in cameras.items():
        for kind in ("images", "bg"):
            (path / kind / name).mkdir(parents=True)
        for t in range(FRAMES):
            view = Camera(K, head_fixed(camera.viewmat, frames["rot"][t], frames["tra"][t]), SIZE, SIZE)
            pose = {key: frames[key][t] for key in ("eye_rot", "neck_rot")}
            rgba = avatar.render(frames["expr"][t], view, **pose)
            white = avatar.render(frames["expr"][t], view, background=(1.0, 1.0, 1.0), **pose)[..., :3]
            image = (rgba[..., :3] if mattes else white) / 255  # a matte takes colours without background
            image = np.clip(image + noise * rng.normal(size=image.shape), 0, 1)
            write_image(path / "images" / name / f"{t:05d}.png", image)
            if mattes:
                write_image(path / "bg" / name / f"{t:04d}.png", rgba[..., 3] / np.float32(255))
    return path


@pytest.fixture(scope="module")
def avatar_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "tiny.cap4d"
    write_bundle(tiny_bundle(network=False), path)
    return path


@pytest.fixture(scope="module")
def avatar(avatar_file) -> Avatar:
    return Avatar.load(avatar_file)


@pytest.fixture(scope="module")
def exact(tmp_path_factory, avatar) -> Path:
    return write_capture(tmp_path_factory.mktemp("exact") / "cap", avatar)


def test_an_avatar_is_exactly_like_a_film_of_itself(avatar_file, exact):
    found = evaluate(avatar_file, exact, only=PIXELS)
    assert found.views == tuple((name, t) for name in ("left", "right") for t in range(FRAMES))
    np.testing.assert_allclose(found.values("PSNR"), 100)
    np.testing.assert_allclose(found.values("SSIM"), 1)
    assert found.mean("PSNR-fg") is None  # no mattes


def test_noise_is_measured_as_it_is(tmp_path, avatar_file, avatar):
    capture = write_capture(tmp_path / "cap", avatar, noise=0.02, mattes=True)
    found = evaluate(avatar_file, capture, only=PIXELS)
    assert found.mean("PSNR-fg") == pytest.approx(-20 * np.log10(0.02), abs=0.3)
    assert found.mean("PSNR") > found.mean("PSNR-fg")  # the background is white in both
    assert found.pooled_psnr() == pytest.approx(found.mean("PSNR"), abs=0.1)


def test_another_identity_is_measured_and_another_rig_refused(tmp_path, avatar_file, avatar):
    capture = write_capture(tmp_path / "cap", avatar, rig="another_rig")
    with pytest.raises(DataError, match=r"fit\.npz: rig_name: expected tiny, .* found another_rig"):
        evaluate(avatar_file, capture, only=PIXELS)
    path = tmp_path / "larger.cap4d"
    bundle = tiny_bundle(network=False)
    ball = replace(bundle.mesh_subject, neutral=1.05 * bundle.mesh_subject.neutral)
    subject = ball.resample(bundle.grid.vertices, bundle.grid.bary)
    write_bundle(replace(bundle, subject=subject, mesh_subject=ball), path)
    own = write_capture(tmp_path / "own", avatar)
    assert 10 < evaluate(path, own, only=PIXELS).mean("PSNR") < 40


def test_a_capture_with_other_expressions_is_refused(tmp_path, avatar_file, exact):
    import shutil

    capture = tmp_path / "cap"
    shutil.copytree(exact, capture)
    with np.load(capture / "fit.npz") as arrays:
        changed = {**arrays, "expr": np.zeros((FRAMES, 3), np.float32)}
    np.savez(capture / "fit.npz", **changed)
    with pytest.raises(DataError, match=r"expr: expected float32\[T, 5\]"):
        evaluate(avatar_file, capture, only=PIXELS)


def test_smaller_pictures_are_compared_with_averaged_truth(avatar_file, exact):
    pytest.importorskip("torch", reason="needs the extra [fit]")
    found = evaluate(avatar_file, exact, only=PIXELS, size=24)
    assert found.facts["sizes"] == [[24, 24]]
    assert 20 < found.mean("PSNR") < 100
    assert evaluate(avatar_file, exact, only=PIXELS, size=96).facts["sizes"] == [[SIZE, SIZE]]
    with pytest.raises(ArgumentError, match="size"):
        evaluate(avatar_file, exact, size=8)


def test_views_are_those_asked_for(avatar_file, exact):
    views = [("right", 3), ("left", 5), ("right", 1), ("right", 3)]
    found = evaluate(avatar_file, exact, views=views, only=PIXELS)
    assert found.views == (("left", 5), ("right", 1), ("right", 3))
    for wrong in ([("right", 99)], [("top", 0)], []):
        with pytest.raises(ArgumentError, match=r"^views: expected"):
            evaluate(avatar_file, exact, views=wrong)


def test_views_are_selected_by_camera_frame_and_mark(exact):
    capture = Capture.load(exact)
    assert len(select_views(capture)) == 2 * FRAMES
    assert select_views(capture, cameras=["right"], frames=slice(0, 6, 4)) == [("right", 0), ("right", 4)]
    assert select_views(capture, frames=slice(-1, None)) == [("left", 5), ("right", 5)]
    with pytest.raises(ArgumentError, match="cameras: expected some of left, right, got top"):
        select_views(capture, cameras=["top"])
    with pytest.raises(ArgumentError, match="views"):
        select_views(capture, frames=slice(99, None))
    pytest.importorskip("torch", reason="needs the extra [fit]")
    assert select_views(capture, held_out=True) == [("left", 4), ("right", 4)]


@pytest.mark.parametrize(
    ("text", "frames"),
    [("0:100:2", slice(0, 100, 2)), ("5:", slice(5, None)), (":9", slice(None, 9)), ("7", slice(7, 8))],
)
def test_frames_are_written_as_slices(text, frames):
    assert parse_frames(text) == frames


@pytest.mark.parametrize("text", ["", "a", "1:2:3:4", "1:2:0", "1:2:-1", "-3", "1.5:2"])
def test_what_are_no_frames(text):
    with pytest.raises(ArgumentError, match=r"^frames: expected FIRST:END"):
        parse_frames(text)


def test_runs_are_of_one_camera_and_frame_after_frame(exact):
    capture = Capture.load(exact)
    views = [v for v in capture.views if (v.camera, v.frame) not in (("left", 2), ("right", 0))]
    found = runs(views, [capture.camera(view) for view in views])
    assert [[(views[i].camera, views[i].frame) for i in run] for run in found] == [
        [("left", 0), ("left", 1)],
        [("left", 3), ("left", 4), ("left", 5)],
        [("right", t) for t in range(1, 6)],
    ]


def test_pictures_are_kept_where_asked(tmp_path, avatar_file, exact):
    evaluate(avatar_file, exact, views=[("right", 3)], only=PIXELS, pictures=tmp_path / "pictures")
    drawn = read_image(tmp_path / "pictures" / "right" / "00003.png")
    np.testing.assert_array_equal(drawn, read_image(exact / "images" / "right" / "00003.png"))
    sheet = read_image(tmp_path / "pictures" / "sheet.png")
    np.testing.assert_array_equal(sheet, np.concatenate([drawn, drawn, np.zeros_like(drawn)], 1))
    assert len(list((tmp_path / "pictures").rglob("*.png"))) == 2


def test_the_report_is_json_and_says_what_was_not_measured(tmp_path, avatar_file, exact, capsys, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    report = tmp_path / "report.json"
    words = ["evaluate", str(avatar_file), str(exact), "--cameras", "left", "--frames", "0:6:2"]
    assert cli.main([*words, "--metrics", "PSNR,PSNR-fg,LPIPS,CSIM,AED,APD", "-o", str(report)]) == 0
    printed = capsys.readouterr().out
    assert "PSNR        100.00 dB           3/3" in printed
    assert "PSNR-fg       none dB           0/3" in printed
    assert "CSIM: not measured: needs an ArcFace network" in printed
    assert printed.count("not measured: needs a regressor") == 1 and "AED, APD: not measured" in printed

    document = json.loads(report.read_text())
    assert document["views"] == [["left", 0], ["left", 2], ["left", 4]]
    psnr, csim = document["metrics"]["PSNR"], document["metrics"]["CSIM"]
    assert psnr["values"] == [100.0] * 3 and psnr["mean"] == psnr["by_camera"]["left"] == 100.0
    assert "sRGB" in psnr["definition"]
    assert document["metrics"]["PSNR-fg"]["values"] == [None] * 3
    assert document["metrics"]["PSNR-fg"]["not_found"] == 3
    assert csim["mean"] is None and csim["not_measured"].startswith("needs an ArcFace network")
    assert document["rig"] == RIG_NAME and document["versions"]["numpy"] == np.__version__
    assert document["background"].endswith("by its matte in 0 of 3 views")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--cameras", "top"], 2, "cameras: expected some of left, right, got top"),
        (["--frames", "x"], 2, "frames: expected FIRST:END"),
        (["--metrics", "VMAF"], 2, "metrics: expected some of PSNR"),
        (["--arcface", "gone.onnx", "--metrics", "CSIM"], 2, "gone.onnx: cannot be read"),
        (["-o", "no/such/folder/report.json"], 2, "folder"),
    ],
)
def test_a_wrong_argument_is_one_line(avatar_file, exact, capsys, words, code, said):
    if "--arcface" in words:
        pytest.importorskip("mediapipe", reason="needs mediapipe")
    assert cli.main(["evaluate", str(avatar_file), str(exact), *words]) == code
    error = capsys.readouterr().err.strip()
    assert said in error and "\n" not in error


def test_an_interrupted_run_leaves_no_report(tmp_path, avatar_file, exact, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("cap4d.evaluate.metrics.ssim.Ssim.measure", interrupted)
    report = tmp_path / "report.json"
    assert cli.main(["evaluate", str(avatar_file), str(exact), "--metrics", "SSIM", "-o", str(report)]) == 130
    assert not list(tmp_path.iterdir())


def test_films_are_measured_run_by_run(avatar_file, exact, monkeypatch):
    """JOD's stand-in takes its pairs as FovVideoVDP does; other metrics see each pair once, too."""
    from cap4d.evaluate.metrics import jod, registry

    class Film(jod.JustObjectionableDifference):
        def __init__(self) -> None:
            self.asked = []

        def measure_video(self, pairs, *, count, fps):
            taken = [next(pairs) for _ in range(count)]
            self.asked.append((count, fps, len({id(pair) for pair in taken})))
            return 10.0 - count

    film = Film()
    monkeypatch.setattr(registry.jod, "find", lambda _: film)
    views = [("left", 0), ("left", 1), ("left", 2), ("left", 5), ("right", 4), ("right", 5)]
    found = evaluate(avatar_file, exact, views=views, only=["PSNR", "JOD"])
    assert film.asked == [(3, 25.0, 3), (1, 25.0, 1), (2, 25.0, 2)]
    np.testing.assert_array_equal(found.values("JOD"), [7, 7, 7, 9, 8, 8])
    np.testing.assert_allclose(found.values("PSNR"), 100)


def test_a_face_is_looked_for_where_there_is_one(avatar_file, avatar, tmp_path, monkeypatch):
    pytest.importorskip("mediapipe", reason="needs mediapipe")
    from cap4d.evaluate.faces import FaceFinder

    capture = write_capture(tmp_path / "cap", avatar)
    with np.load(capture / "fit.npz") as arrays:
        turned = np.zeros((FRAMES, 3), np.float32)
        turned[:, 1] = np.radians([0, 60, 90, 180, -60, -90])
        np.savez(tmp_path / "fit.npz", **{**arrays, "rot": turned})
    (tmp_path / "fit.npz").replace(capture / "fit.npz")
    looked = []
    monkeypatch.setattr(FaceFinder, "_look", lambda self, image: looked.append(image))
    views = [("left", t) for t in range(FRAMES)]
    found = evaluate(avatar_file, capture, views=views, only=["AKD"])
    assert len(looked) == 2 * 3
    assert found.facts["views_of_a_face"] == 3


def test_one_finder_looks_at_a_truth_once(avatar_file, exact, monkeypatch):
    """Two evaluations on a capture look at two pictures of the avatar and one truth."""
    pytest.importorskip("mediapipe", reason="needs mediapipe")
    from cap4d.evaluate.faces import FaceFinder

    looked = []
    monkeypatch.setattr(FaceFinder, "_look", lambda self, image: looked.append(image))
    with FaceFinder() as finder:
        for _ in range(2):
            found = evaluate(avatar_file, exact, views=[("left", 1)], only=["AKD"], finder=finder)
            assert found.mean("AKD") is None
    assert len(looked) == 3
    counts = found.document()["faces"]
    assert counts == {"views": 1, "in_picture": 0, "in_truth": 0, "in_both": 0, "lost_by_avatar": 0}
