"""The whole road on a real video: track, fit, fit without the U-Net, play on both backends. Half an hour.

    python -m pytest -m bench -s tests/bench/bench_talking_head.py

Leaves everything it makes in out/talking_head for the eye: overlays, held-out frames, videos.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.bench
OUT = Path(__file__).resolve().parents[2] / "out" / "talking_head"


def run(module: str, *words: object) -> None:
    subprocess.run([sys.executable, "-m", module, *map(str, words)], check=True)


@pytest.fixture(scope="module")
def road(shared: Path) -> Path:
    """out/talking_head with ict.npz, cap/, me.cap4d and without_unet.cap4d."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    rig = OUT / "ict.npz"
    run("cap4d.cli", "rig", "import", "ict", shared / "ict/ict_facekit_light.npz", "-o", rig)
    run("cap4d.cli", "track", shared / "video/talking_head.mp4", "--rig", rig, "-o", OUT / "cap")
    run("cap4d.cli", "fit", OUT / "cap", "--rig", rig, "--preset", "low", "-o", OUT / "me.cap4d")
    run(
        "cap4d.cli",
        "fit",
        OUT / "cap",
        "--rig",
        rig,
        "--preset",
        "low",
        "--ablate",
        "unet",
        "-o",
        OUT / "without_unet.cap4d",
    )
    return OUT


def test_the_avatar_beats_the_nearest_training_frame(road: Path) -> None:
    report, without = (json.loads((road / f"{name}.fit.json").read_text()) for name in ("me", "without_unet"))
    for key in ("held_out_psnr", "nearest_frame_psnr", "held_out_psnr_mean", "nearest_frame_psnr_mean"):
        print(f"{key}: {report[key]:.2f} dB, without the U-Net {without[key]:.2f} dB")
    print(f"{report['seconds']:.0f} s, {report['peak_memory_mb']:.0f} MB")
    assert report["held_out_psnr"] >= report["nearest_frame_psnr"] + 2
    assert without["held_out_psnr"] <= report["held_out_psnr"]
    assert report["seconds"] < 3600 and report["peak_memory_mb"] < 8000


def test_both_backends_draw_the_same_frames(road: Path) -> None:
    for backend in ("cpu", "gl"):
        (road / backend).mkdir()
        run("cap4d.app.main", road / "me.cap4d", "--headless", "--backend", backend, "--frames", 120,
            "--out", road / backend / "frame_%04d.png", "--stats", road / f"{backend}.json")  # fmt: skip
    worst = min(psnr(frame, road / "gl" / frame.name) for frame in sorted((road / "cpu").glob("*.png")))
    print(f"GL against CPU: worst of 120 frames {worst:.1f} dB")
    assert worst >= 40


def psnr(a: Path, b: Path) -> float:
    from cap4d.capture.image import read_image

    return float(-10 * np.log10(np.square(read_image(a) - read_image(b)).mean() + 1e-12))
