"""Pictures, videos, camera paths, and the loop that makes them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import tiny_bundle

from cap4d.bundle import write_bundle
from cap4d.camera import head_fixed
from cap4d.errors import ArgumentError, DataError
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import camera_path, file_path, fitted, orbit_path
from cap4d.player.offline import Output, frame_count, parse_size, render_clip, render_file, render_to
from cap4d.player.png import encode_png, write_png
from cap4d.player.stages import Stages, peak_memory_mb
from cap4d.player.video import VideoWriter


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return Avatar(tiny_bundle(8, gaussians=2))


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as file:
        return [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]


def picture(height: int = 12, width: int = 18, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(0).integers(256, size=(height, width, channels), dtype=np.uint8)


# PNG


@pytest.mark.parametrize(("channels", "pixel_format"), [(3, "rgb24"), (4, "rgba")])
def test_png_keeps_every_value(channels: int, pixel_format: str, tmp_path: Path) -> None:
    image = picture(channels=channels)
    write_png(tmp_path / "a.png", image)
    with av.open(str(tmp_path / "a.png")) as file:
        frame = next(file.decode(video=0))
    assert frame.format.name == pixel_format
    assert np.array_equal(frame.to_ndarray(format=pixel_format), image)


def test_png_is_reproducible_and_compressed() -> None:
    flat = np.full((64, 64, 3), 7, np.uint8)
    assert encode_png(flat) == encode_png(flat.copy())
    assert len(encode_png(flat)) < 300


@pytest.mark.parametrize("image", [picture().astype(np.float32), picture()[..., 0], picture()[:0]])
def test_png_of_something_else_is_refused(image: np.ndarray) -> None:
    with pytest.raises(ArgumentError, match="image: expected uint8"):
        encode_png(image)


# Video


def test_a_video_has_its_frames_colours_and_tags(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    colours = [(200, 40, 40), (40, 200, 40), (40, 40, 200)] * 4
    with VideoWriter(path, fps=25) as video:
        for colour in colours:
            video.write(np.full((32, 48, 3), colour, np.uint8))
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 25)
        tags = (context.color_primaries, context.color_trc, context.colorspace, context.color_range)
        assert tags == (1, 1, 1, 1)  # BT.709 throughout, limited range
        frames = [f.to_ndarray(format="rgb24") for f in file.decode(video=0)]
    assert len(frames) == len(colours)
    for frame, colour in zip(frames, colours, strict=True):
        assert np.abs(frame.astype(int) - colour).max() <= 8
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_odd_sizes_are_padded(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", fps=24) as video:
        video.write(picture(33, 47))
    assert decoded(tmp_path / "a.mp4")[0].shape == (34, 48, 3)


def test_fractional_rates(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", fps=30000 / 1001) as video:
        video.write(picture())
    with av.open(str(tmp_path / "a.mp4")) as file:
        assert float(file.streams.video[0].average_rate) == pytest.approx(29.97, abs=1e-3)


def test_an_interrupted_video_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", fps=24) as video:
        video.write(picture())
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"old"


def test_numbered_pngs(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "frame_%04d.png", fps=24) as video:
        for _ in range(3):
            video.write(picture())
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"frame_000{i}.png" for i in range(3)]


def test_one_png_takes_one_frame(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.png", fps=24) as video:
        video.write(picture())
        with pytest.raises(ArgumentError, match="more than one frame"):
            video.write(picture())


@pytest.mark.parametrize(
    "name", ["a.gif", "a", "nowhere/a.mp4", "x%_%04d.png", "x%04d_%04d.png", "folder.png", "folder.mp4"]
)
def test_other_outputs_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(ArgumentError, match="output"):
        VideoWriter(tmp_path / name, fps=24)


@pytest.mark.parametrize("name", ["100%.png", "100%.mp4", "f_%3d.png"])
def test_a_name_may_hold_a_percent_sign(name: str, tmp_path: Path) -> None:
    with VideoWriter(tmp_path / name, fps=24) as video:
        video.write(picture())
    assert [p.name for p in tmp_path.iterdir()] == [name.replace("%3d", "  0")]


def test_alpha_does_not_show_in_a_video(tmp_path: Path) -> None:
    image, videos = picture(20, 30, 4), []
    for name, frame in (("a.mp4", image), ("b.mp4", image[..., :3])):
        with VideoWriter(tmp_path / name, fps=24) as video:
            video.write(frame)
        videos.append(decoded(tmp_path / name)[0])
    assert np.array_equal(*videos)


def test_a_video_refuses_what_its_codec_would(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", fps=24) as video, pytest.raises(ArgumentError, match="8192 px"):
        video.write(np.zeros((1, 8193, 3), np.uint8))
    with pytest.raises(ArgumentError, match="frames per second"):
        VideoWriter(tmp_path / "a.mp4", fps=1e-5)
    assert not list(tmp_path.iterdir())


# Cameras


def test_orbit_looks_at_the_middle_from_the_same_distance(avatar: Avatar) -> None:
    target = np.array([0.01, -0.02, 0.03])
    path = orbit_path(avatar.camera, target, fps=24)
    frame = avatar.idle.frame(0)
    depth = (avatar.camera.viewmat @ [*target, 1])[2]
    positions = []
    for index in range(0, 192, 16):
        camera = path(index, frame)
        np.testing.assert_allclose(camera.project(target), [32, 32, depth], atol=1e-9)
        positions.append(camera.position - target)
    away = np.array(positions) / depth
    yaw = np.degrees(np.arctan2(away[:, 0], -away[:, 2]))
    pitch = np.degrees(np.arcsin(-away[:, 1]))
    assert yaw[0] == pytest.approx(55) and pitch[0] == pytest.approx(0, abs=1e-9)
    assert pitch[3] == pytest.approx(20) and yaw[3] == pytest.approx(0, abs=1e-9)
    assert yaw[6] == pytest.approx(-55)
    np.testing.assert_allclose(path(192, frame).viewmat, path(0, frame).viewmat, atol=1e-9)


def test_a_fitted_camera_sees_everything_unstretched(avatar: Avatar) -> None:
    wide = fitted(avatar.camera, (160, 96))
    assert wide.K[0, 0] == wide.K[1, 1] == avatar.camera.K[1, 1] * 1.5
    assert wide.K[:2, 2].tolist() == [80, 48]
    assert fitted(avatar.camera, None) is avatar.camera


def trajectory(path: Path, count: int = 3, **changes: object) -> Path:
    column = np.ones((count, 1))
    extr = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    extr[:, 2, 3] = np.arange(count)
    arrays = dict(extr=extr, fx=500 * column, fy=400 * column, cx=32 * column, cy=24 * column)
    arrays |= dict(resolution=np.array([48, 64])) | changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return path


def test_a_trajectory_has_a_camera_for_each_frame(avatar: Avatar, tmp_path: Path) -> None:
    path, frame = file_path(trajectory(tmp_path / "t.npz"), None), avatar.idle.frame(0)
    camera = path(1, frame)
    assert (camera.width, camera.height) == (64, 48)
    assert camera.K[:2].tolist() == [[500, 0, 32], [0, 400, 24]] and camera.viewmat[2, 3] == 1
    assert path(4, frame).viewmat[2, 3] == 1  # starts again
    posed = replace(frame, rot=np.float32([0.1, 0.2, 0]), tra=np.float32([0, 0, -1.4]))
    np.testing.assert_allclose(path(1, posed).viewmat, head_fixed(camera.viewmat, posed.rot, posed.tra))


def test_a_fit_gives_its_first_camera(avatar: Avatar, tmp_path: Path) -> None:
    fit = trajectory(tmp_path / "f.npz", 2, resolution=None, resolutions=np.array([[48, 64], [10, 10]]))
    path, frame = file_path(fit, (32, 24)), avatar.idle.frame(0)
    assert path(0, frame).viewmat[2, 3] == path(7, frame).viewmat[2, 3] == 0
    assert path(0, frame).K[0, 0] == 250


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        (dict(extr=None), "extr"),
        (dict(extr=np.eye(4)), "extr"),
        (dict(extr=np.full((3, 4, 4), np.nan)), "extr"),
        (dict(extr=np.zeros((0, 4, 4))), "extr"),
        (dict(fx=np.ones((2, 1))), "fx"),
        (dict(fy=-np.ones((3, 1))), "fx, fy"),
        (dict(resolution=np.array([0, 5])), "resolution"),
        (dict(resolution=np.array([1 << 20, 5])), "resolution"),
        (dict(resolution=None), "resolutions"),
        (dict(cx=np.array([[None]] * 3, object)), "cx"),
    ],
)
def test_malformed_cameras_are_refused(changes: dict, field: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f": {field}: expected"):
        file_path(trajectory(tmp_path / "t.npz", **changes), None)


def test_an_unknown_camera_is_an_argument_error(avatar: Avatar) -> None:
    with pytest.raises(ArgumentError, match="camera: expected static, orbit or"):
        camera_path("spiral", avatar.camera, np.zeros(3), fps=24, size=None)


# The loop


def test_the_clip_plays_once_unless_told_otherwise(avatar: Avatar) -> None:
    path = camera_path("static", avatar.camera, np.zeros(3), fps=24, size=(16, 16))
    images = list(render_clip(avatar, avatar.idle, path))
    assert len(images) == len(avatar.idle) == 12
    assert all(i.shape == (16, 16, 3) and i.dtype == np.uint8 for i in images)
    assert any(not np.array_equal(images[0], image) for image in images)
    assert frame_count(avatar.idle, None, 48.0) == 24 and frame_count(avatar.idle, 100, 24.0) == 100


def test_a_pipeline_draws_the_same_pictures(avatar: Avatar) -> None:
    path = camera_path("static", avatar.camera, np.zeros(3), fps=24, size=(16, 16))
    alone, ahead = (
        list(render_clip(avatar, avatar.idle, path, frames=7, pipelined=p)) for p in (False, True)
    )
    assert len(alone) == 7 and all(np.array_equal(a, b) for a, b in zip(alone, ahead, strict=True))


def test_render_to_writes_what_it_drew_and_its_times(avatar: Avatar, tmp_path: Path) -> None:
    output = Output(tmp_path / "a.mp4", frames=9, size=(48, 32), stats=tmp_path / "s.json")
    stats = render_to(avatar, avatar.idle, "orbit", output)
    frames = decoded(tmp_path / "a.mp4")
    assert len(frames) == 9 and frames[0].shape == (32, 48, 3)
    assert np.std(frames[0]) > 20
    assert stats == json.loads((tmp_path / "s.json").read_text())
    assert (stats["frames"], stats["width"], stats["height"], stats["backend"]) == (9, 48, 32, "cpu")
    parts = {"project", "sort", "tiles", "rasterize"}
    assert set(stats["stages"]) == {"rig", "deform", "bind", "splat", "frame", "write"} | parts
    assert set(stats["stages"]["splat"]) == {"median_ms", "p95_ms", "p99_ms"}
    assert stats["dropped"] == stats["late"] == 0 and stats["memory_mb"] > 10 and stats["fps"] > 0


def test_a_long_render_says_how_far_it_is(avatar: Avatar, monkeypatch, caplog) -> None:
    monkeypatch.setattr("cap4d.player.offline.PROGRESS_SECONDS", -1.0)
    caplog.set_level("INFO")
    render_to(avatar, avatar.idle, "static", Output(None, frames=2))
    said = [message.split(",")[0] for message in caplog.messages if message.startswith("frame")]
    assert said == ["frame 1 of 2", "frame 2 of 2"]


def test_another_backend_draws_the_same_frames(avatar: Avatar, tmp_path: Path) -> None:
    seen = []

    def draw(player: Avatar, frame, camera) -> np.ndarray:
        seen.append((frame.t, camera.width))
        return np.zeros((camera.height, camera.width, 4), np.uint8)

    stats = render_to(avatar, avatar.idle, "static", Output(None, frames=3), draw=draw, backend="gl")
    assert [t for t, _ in seen] == pytest.approx([0, 1 / 24, 2 / 24]) and stats["backend"] == "gl"


def test_render_file_is_the_whole_of_cap4d_render(tmp_path: Path) -> None:
    write_bundle(tiny_bundle(8, gaussians=1), tmp_path / "a.cap4d")
    found = render_file(tmp_path / "a.cap4d", str(tmp_path / "f_%02d.png"), size="20x20", frames=2)
    assert found["frames"] == 2 and sorted(p.name for p in tmp_path.glob("*.png")) == ["f_00.png", "f_01.png"]


@pytest.mark.parametrize("size", ["512", "0x5", "axb", "5x", "-1x4", "99999x5", "1x2x3", "16384x16384"])
def test_parse_size_refuses(size: str) -> None:
    with pytest.raises(ArgumentError, match="size: expected WIDTHxHEIGHT"):
        parse_size(size)


def test_no_frames_is_an_argument_error(avatar: Avatar) -> None:
    with pytest.raises(ArgumentError, match="frames: expected at least 1"):
        render_to(avatar, avatar.idle, "static", Output(None, frames=0))


@pytest.mark.parametrize(
    ("output", "words"),
    [
        (Output("a.png"), "more than one frame"),
        (Output("x%_%04d.png"), "no other %"),
        (Output("a.mp4", stats=Path("nowhere/s.json")), "stats: the folder of nowhere/s.json does not exist"),
        (Output("a.mp4", stats=Path(".")), "stats: expected a file, . is a folder"),
        (Output("a.mp4", size=(16384, 16384)), "at most 8192 px"),
        (Output("nowhere/a.mp4"), "the folder of nowhere/a.mp4 does not exist"),
    ],
)
def test_what_cannot_be_written_is_not_drawn(
    output: Output, words: str, avatar: Avatar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(*_: object) -> np.ndarray:
        raise AssertionError("drew a frame")

    monkeypatch.chdir(tmp_path)
    with pytest.raises(ArgumentError, match=words):
        render_to(avatar, avatar.idle, "static", output, draw=draw)
    assert not list(tmp_path.iterdir())


def test_a_clip_of_another_rig_is_refused_before_anything_is_written(avatar: Avatar, tmp_path: Path) -> None:
    other = replace(avatar.idle, rig_name="flame2023_no_jaw")
    with pytest.raises(ArgumentError, match="expected expressions of tiny"):
        render_to(avatar, other, "static", Output(tmp_path / "a.mp4"))
    assert not list(tmp_path.iterdir())


def test_stages_report_percentiles() -> None:
    stages = Stages()
    for ms in range(1, 101):
        stages.add("net", ms / 1000)
    assert stages.report()["net"] == {"median_ms": 50.5, "p95_ms": 95.05, "p99_ms": 99.01}
    with stages.time("rig"):
        pass
    assert list(stages.report()) == ["net", "rig"]
    stages.clear()
    assert stages.report() == {} and peak_memory_mb() > 10
