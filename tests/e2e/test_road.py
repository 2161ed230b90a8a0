"""The whole story in one file: a head model, a capture of it, an avatar, the viewer playing it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("OpenImageIO")


def run(*words: object) -> str:
    """Runs `cap4d WORDS...` (or `cap4d-view`, when the first word is `view`) as a user would."""
    module = "cap4d.app.main" if words[0] == "view" else "cap4d.cli"
    words = words[1:] if words[0] == "view" else words
    done = subprocess.run(
        [sys.executable, "-m", module, *map(str, words)], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with rig.npz, capture/ and avatar.cap4d, each made by the command that users run."""
    from cap4d.rig.store import load_rig
    from cap4d.synth.capture import synthesize

    folder = tmp_path_factory.mktemp("road")
    run("rig", "import", "builtin", "-o", folder / "rig.npz")
    synthesize(load_rig(folder / "rig.npz"), folder / "capture", views=6, frames=24, size=128, seed=3)
    run(
        "fit",
        folder / "capture",
        "--rig",
        folder / "rig.npz",
        "--preset",
        "debug",
        "-o",
        folder / "avatar.cap4d",
    )
    return folder


def test_held_out_views_look_like_the_head(road: Path) -> None:
    report = json.loads((road / "avatar.fit.json").read_text())
    assert report["held_out_psnr"] > 24
    assert report["held_out_psnr"] > report["nearest_frame_psnr"]
    assert report["peak_memory_mb"] < 8000


def test_inspect_names_what_is_inside(road: Path) -> None:
    printed = run("inspect", road / "avatar.cap4d")
    assert "builtin" in printed and "jawOpen" in printed


def test_the_viewer_plays_the_idle_clip_without_a_display(road: Path) -> None:
    import av

    stats = road / "stats.json"
    run("view", road / "avatar.cap4d", "--headless", "--backend", "cpu", "--frames", 20, "--size", "128x128",
        "--out", road / "out.mp4", "--stats", stats)  # fmt: skip
    with av.open(str(road / "out.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 20 and frames[0].shape == (128, 128, 3)
    assert frames[0].std() > 20, "the picture is blank"
    assert json.loads(stats.read_text())["frames"] == 20


def test_an_expression_changes_the_picture_where_it_should(road: Path) -> None:
    import cap4d

    avatar = cap4d.Avatar.load(road / "avatar.cap4d")
    camera = avatar.camera.resized(128, 128)
    names = avatar.bundle.subject.expression_names
    neutral = avatar.render(np.zeros(len(names), np.float32), camera, background=(1, 1, 1)).astype(float)
    opened = np.zeros(len(names), np.float32)
    opened[names.index("jawOpen")] = 1
    change = np.abs(avatar.render(opened, camera, background=(1, 1, 1)).astype(float) - neutral)[
        ..., :3
    ].mean(-1)
    rows = change.sum(1)
    assert change.max() > 40
    assert np.average(np.arange(128), weights=rows) > 64, "opening the jaw moves the lower half of the face"
