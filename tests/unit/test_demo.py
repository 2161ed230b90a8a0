"""The demo's cache: what is made once, and when it is made anew. Nothing is tracked or fitted here."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from cap4d import cli, demo
from cap4d.errors import ArgumentError

pytest.importorskip("torch")
pytest.importorskip("cv2")


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was tracked and fitted, instead of doing it."""
    done: list[str] = []

    def track(video: Path, rig: object, capture: Path) -> None:
        done.append("track")
        capture.mkdir()

    def fit(captures: list[Path], rig: object, avatar: Path, *, preset: str, resume: bool, seed: int) -> None:
        assert resume and captures[0].is_dir()
        done.append("fit")
        avatar.write_text(preset)

    monkeypatch.setattr("cap4d.track.track", track)
    monkeypatch.setattr("cap4d.avatar.fit.fit", fit)
    return done


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "me.mp4"
    path.write_bytes(b"a video")
    return path


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """The demo avatars that were built, into a cache of the test's own."""
    done: list[Path] = []

    def build(rig: object, path: Path) -> None:
        path.parent.mkdir(exist_ok=True)
        path.write_text("an avatar")
        done.append(path)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(demo, "build_demo_avatar", build)
    return done


def test_the_demo_is_built_once_and_then_found_without_its_head(built, monkeypatch) -> None:
    path = demo.demo_avatar_path()
    assert built == [path]
    monkeypatch.setattr("cap4d.rig.builtin.build_head", lambda: pytest.fail("the head was built"))
    assert demo.demo_avatar_path() == path


def test_other_code_or_a_lost_avatar_is_looked_for_anew(built, monkeypatch) -> None:
    path = demo.demo_avatar_path()
    path.unlink()
    assert demo.remembered_demo() is None
    assert demo.demo_avatar_path() == path
    assert built == [path, path]
    monkeypatch.setattr(demo, "code_fingerprint", lambda: "other")
    assert demo.remembered_demo() is None


@pytest.mark.parametrize("content", ["", "[", "{}", "[1]", '["CODE", "../../etc/passwd"]', '["CODE", 3]'])
def test_a_broken_record_is_none(built, content) -> None:
    demo.demo_avatar_path()
    content = content.replace("CODE", demo.code_fingerprint())
    (demo.cache_folder() / demo.DEMO_RECORD).write_text(content)
    assert demo.remembered_demo() is None


def test_the_road_is_walked_once(work, video, tmp_path, builtin_rig) -> None:
    first = demo.avatar_from_video(video, builtin_rig, tmp_path / "a" / "out", preset="low")
    again = demo.avatar_from_video(video, builtin_rig, tmp_path / "a" / "out", preset="low")
    assert first == again and first.is_file() and first.name.startswith("me-low-")
    assert work == ["track", "fit"]


def test_another_preset_fits_the_same_capture(work, video, tmp_path, builtin_rig) -> None:
    made = {demo.avatar_from_video(video, builtin_rig, tmp_path, preset=p) for p in ("low", "debug")}
    assert len(made) == 2 and work == ["track", "fit", "fit"]


def test_another_video_or_rig_of_the_same_name_is_another_avatar(work, video, tmp_path, builtin_rig) -> None:
    def walk(path: Path, rig=builtin_rig) -> Path:
        return demo.avatar_from_video(path, rig, tmp_path / "out", preset="low")

    made = [walk(video)]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "me.mp4").write_bytes(video.read_bytes())
    made.append(walk(tmp_path / "other" / "me.mp4"))
    os.utime(video, ns=(1, 1))
    made.append(walk(video))
    made.append(walk(video, replace(builtin_rig, colors=None)))
    made.append(walk(video, replace(builtin_rig, name="another")))
    assert len(set(made)) == 5 and work == ["track", "fit"] * 5


def test_an_interrupted_fit_keeps_its_capture(work, video, tmp_path, builtin_rig, monkeypatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("cap4d.avatar.fit.fit", interrupted)
        demo.avatar_from_video(video, builtin_rig, tmp_path / "out", preset="low")
    demo.avatar_from_video(video, builtin_rig, tmp_path / "out", preset="low")
    assert work == ["track", "fit"]


def test_a_missing_video_makes_nothing(work, tmp_path, builtin_rig) -> None:
    with pytest.raises(ArgumentError, match="nothing at"):
        demo.avatar_from_video(tmp_path / "no.mp4", builtin_rig, tmp_path / "out", preset="low")
    assert not list(tmp_path.iterdir()) and work == []
    assert cli.main(["demo", "--video", str(tmp_path / "no.mp4"), "--out", str(tmp_path / "out")]) == 2
    assert not list(tmp_path.iterdir())


def test_without_a_display_it_leaves_an_orbit_and_a_frontal_picture(monkeypatch, tmp_path) -> None:
    calls: list[list[str]] = []
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(demo.sys, "platform", "linux")
    monkeypatch.setattr(subprocess, "call", lambda words: calls.append(words) or 0)
    assert demo.play(tmp_path / "me.cap4d", tmp_path / "out") == 0
    film, photo = calls
    assert film[film.index("--camera") + 1] == "orbit" and film[-1].endswith("demo.mp4")
    assert photo[photo.index("--camera") + 1] == "static" and photo[-1].endswith("demo.png")
