"""The FLAME road on real-shaped material: import, photos, a debug avatar, and what drives it.

Also prints (with -s) the landmark error of the released fits and the expression error of retargeted vertices.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_road import run

pytest.importorskip("torch")
pytest.importorskip("OpenImageIO")

PHOTOS = ("tesla", "lincoln")


@pytest.fixture(scope="module")
def road(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flame")
    model, assets = shared / "flame/flame_standin.pkl", shared / "flame/cap4d_assets"
    run("rig", "import", "flame", model, "--assets", assets, "-o", folder / "flame.npz")
    run(
        "fit",
        shared / "photos/tesla",
        "--rig",
        folder / "flame.npz",
        "--preset",
        "debug",
        "-o",
        folder / "tesla.cap4d",
    )
    return folder


@pytest.mark.parametrize("name", PHOTOS)
def test_the_fit_projects_onto_the_photo(name: str, shared: Path, road: Path) -> None:
    from cap4d.camera import opencv_from_rig
    from cap4d.capture.capture import Capture
    from cap4d.rig.store import load_rig

    capture, rig = Capture.load(shared / "photos" / name), load_rig(road / "flame.npz")
    camera = capture.head_camera(capture.views[0])
    vertices = rig.subject(capture.shape).pose(capture.expr[0], eye_rot=capture.eye_rot[0])
    pixels = camera.project(opencv_from_rig(vertices[:5023].astype(np.float64)))[:, :2]
    with np.load(shared / "photos" / name / "alignment.npz") as alignment:
        truth, weight = alignment["vertex_coords"][0, 0], alignment["vertex_confidences"][0, 0, :, 0]
    scale = 512 / max(camera.width, camera.height)
    seen = weight > np.median(weight)
    error = np.linalg.norm(pixels - truth, axis=1)[seen] * scale
    print(f"{name}: median {np.median(error):.2f} px at 512, p95 {np.percentile(error, 95):.2f} px")
    assert np.median(error) < 8
    run("rig", "show", road / "flame.npz", "--on", shared / "photos" / name, "-o", road / f"{name}.png")
    assert (road / f"{name}.png").stat().st_size > 10_000


def test_a_flowface_sequence_plays(shared: Path, road: Path) -> None:
    out = road / "sequence.mp4"
    run("view", road / "tesla.cap4d", "--headless", "--backend", "cpu", "--size", "128x128", "--frames", 30,
        "--drive", shared / "flame/sequence_00/fit.npz", "--camera", shared / "flame/sequence_00/orbit.npz",
        "--out", out)  # fmt: skip
    frames = decoded(out)
    assert len(frames) == 30
    change = np.abs(np.diff(frames.astype(float), axis=0)).mean((1, 2, 3))
    assert (change > 0.02).all(), "every frame moves"


def test_codetalker_vertices_give_back_the_expressions(shared: Path, road: Path) -> None:
    import cap4d
    from cap4d.drive.source import open_source

    source = next((shared / "flame/codetalker").glob("condition_*.npy"))
    truth = np.load(shared / "flame/codetalker/truth.npz")
    avatar = cap4d.Avatar.load(road / "tesla.cap4d")
    clip = open_source(str(source), avatar.bundle, template=shared / "flame/codetalker/truth.npz")
    assert clip.fps == 30 and clip.expr.shape == truth["expr"].shape
    error = clip.expr - truth["expr"]
    spread = truth["expr"].std(0)
    print(f"expressions: root mean square error {np.sqrt((error**2).mean()):.4f}, spread {spread.mean():.4f}")
    basis = avatar.bundle.subject.expression_basis.reshape(65, -1)
    moved = np.abs(error @ basis).max()
    print(f"largest error of any grid vertex {1e3 * moved:.3f} mm")
    assert moved < 1e-3
    out = road / "speech.mp4"
    run("view", road / "tesla.cap4d", "--headless", "--backend", "cpu", "--size", "96x96",
        "--frames", 12, "--drive", source,
        "--template", shared / "flame/codetalker/truth.npz", "--out", out)  # fmt: skip
    assert len(decoded(out)) == 12


def decoded(path: Path) -> np.ndarray:
    """uint8[T, H, W, 3]"""
    import av

    with av.open(str(path)) as video:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)])
