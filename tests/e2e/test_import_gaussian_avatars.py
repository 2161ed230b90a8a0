"""An avatar of GaussianAvatars, imported, inspected, exported and played: headless, and in the window."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from gaussian_avatars_files import invent
from test_road import run
from x_server import PLAY, needs_x
from x_server import run as run_window

from cap4d.capture.image import read_image


@pytest.fixture(scope="module")
def road(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gaussian_avatars")
    ply, params = invent(faces=9976 + 168, vertices=5023 + 120, gaussians=12_000, frames=30).write(folder)
    run("import", "gaussian-avatars", ply, "--params", params, "--flame", shared / "flame/flame_standin.pkl",
        "-o", folder / "avatar.cap4d")  # fmt: skip
    return folder


def test_it_plays_headless(road: Path) -> None:
    assert "the rig's own triangles" in run("inspect", road / "avatar.cap4d")
    run("view", road / "avatar.cap4d", "--headless", "--backend", "cpu", "--size", "96x96", "--frames", 2,
        "--out", road / "out_%02d.png")  # fmt: skip
    first, second = (read_image(path).astype(float) for path in sorted(road.glob("out_*.png")))
    assert (np.abs(first - second).max(-1) > 0.06).sum() > 100, "the sequence moves the face"


@needs_x
def test_it_plays_in_the_window(road: Path) -> None:
    found, said = run_window(PLAY.replace("NAME", "'avatar.cap4d'"), road)
    assert found == {"rig": "flame_standin", "tier": "off", "messages": []} and said == ""


def test_a_frame_is_exported(road: Path) -> None:
    run("export", road / "avatar.cap4d", "--format", "ply", "--frame", 12, "-o", road / "frame.ply")
    assert b"element vertex 12000\n" in (road / "frame.ply").read_bytes()[:200]
