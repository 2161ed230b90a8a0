"""A whole fit, small: a painted sheet that bulges and shears becomes an avatar file."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tiny_avatar import GRID, tiny_rig, write_tiny_capture

from cap4d.avatar import journal as journal_module
from cap4d.avatar.checkpoint import remove_checkpoints, save_checkpoint
from cap4d.avatar.fit import fit
from cap4d.avatar.presets import PRESETS, Densify
from cap4d.bundle import read_bundle
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError, DataError
from cap4d.player.avatar import Avatar

STEPS = 120
TINY = replace(
    PRESETS["debug"],
    iterations=STEPS,
    image_size=48,
    grid_size=GRID,
    deformer_width=4,
    gaussians=600,
    expression_noise=0.02,
    densify=Densify(start=30, stop=90, every=30, most=800),
    checkpoint_every=20,
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "sheet"
    write_tiny_capture(path)
    return path


@pytest.fixture(scope="module")
def fitted(capture, tmp_path_factory):
    output = tmp_path_factory.mktemp("fits") / "sheet.cap4d"
    return output, fit([capture], tiny_rig(), output, preset=TINY)


def test_it_beats_the_nearest_training_frame(fitted):
    _, report = fitted
    assert report.held_out_frames == 2 + 2
    assert report.held_out_psnr > report.nearest_frame_psnr + 2
    assert report.held_out_psnr > 30
    assert report.held_out_ssim > 0.95


def test_the_report_is_written(fitted):
    output, report = fitted
    written = json.loads(output.with_suffix(".fit.json").read_text())
    assert written["held_out_psnr"] == report.held_out_psnr
    assert written["nearest_frame_psnr"] == report.nearest_frame_psnr
    assert written["seconds"] > 0
    assert 0 < written["step_ms"] < 1e3 * written["seconds"]
    assert (written["device"], written["recipe"], written["perceptual"]) == ("cpu", "short", "none")
    assert written["peak_memory_mb"] > 10
    assert sorted(p.suffix for p in output.parent.iterdir()) == [".cap4d", ".json", ".png"]


def test_the_bundle_holds_the_avatar(fitted, capture):
    output, report = fitted
    bundle = read_bundle(output)
    assert len(bundle) == report.gaussians
    assert bundle.rig_name == "tiny"
    assert bundle.deform_onnx is not None
    assert np.isfinite(bundle.idle.expr).all()
    assert bundle.camera.width == 48


def test_held_out_frames_are_never_looked_at(capture, tmp_path):
    """Spoiling them changes nothing but the verdict on them."""
    import shutil

    from cap4d.capture.image import write_image

    spoiled = tmp_path / "spoiled"
    shutil.copytree(capture, spoiled)
    for view in Capture.load(spoiled).views:
        if view.frame in (9, 19, 22, 23):
            write_image(view.image, np.random.default_rng(view.frame).random((48, 48, 3)))
    short = replace(TINY, iterations=25)
    clean = fit([capture], tiny_rig(), tmp_path / "clean.cap4d", preset=short)
    noisy = fit([spoiled], tiny_rig(), tmp_path / "noisy.cap4d", preset=short)
    assert noisy.held_out_psnr < 12 < clean.held_out_psnr
    a, b = read_bundle(tmp_path / "clean.cap4d"), read_bundle(tmp_path / "noisy.cap4d")
    for field in ("means", "sh", "opacity_logits", "deform_neutral"):
        assert np.array_equal(getattr(a, field), getattr(b, field))


def test_same_seed_same_avatar_other_seed_another(capture, tmp_path):
    short = replace(TINY, iterations=35)
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        fit([capture], tiny_rig(), tmp_path / f"{name}.cap4d", preset=short, seed=seed)
    a, b, c = ((tmp_path / f"{name}.cap4d").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_an_interrupted_fit_goes_on_as_if_nothing_had_happened(capture, tmp_path, monkeypatch):
    short = replace(TINY, iterations=50)
    fit([capture], tiny_rig(), tmp_path / "whole.cap4d", preset=short)

    saved = []

    def save_then_interrupt(state, path):
        save_checkpoint(state, path)
        saved.append(path)
        if len(saved) == 2:  # after the first densification
            raise KeyboardInterrupt

    monkeypatch.setattr(journal_module, "save_checkpoint", save_then_interrupt)
    output = tmp_path / "broken.cap4d"
    with pytest.raises(KeyboardInterrupt):
        fit([capture], tiny_rig(), output, preset=short)
    assert not output.exists()
    left = sorted(p.name for p in tmp_path.glob("*broken*"))
    assert left == ["broken.fit.ckpt", "broken.fit.ckpt.previous"]
    monkeypatch.undo()
    fit([capture], tiny_rig(), output, preset=short, resume=True)
    assert output.read_bytes() == (tmp_path / "whole.cap4d").read_bytes()
    assert not list(tmp_path.glob("*broken*.ckpt*"))


def test_a_checkpoint_of_another_fit_is_refused(capture, tmp_path):
    checkpoint = tmp_path / "x.fit.ckpt"
    save_checkpoint({"kind": "something else", "trainer": {}, "seconds": 0.0}, checkpoint)
    with pytest.raises(DataError, match="kind: expected preset") as refused:
        fit([capture], tiny_rig(), tmp_path / "x.cap4d", preset=TINY, resume=True)
    kind = re.search(r"kind: expected (.*), found", str(refused.value)).group(1)
    for trainer in ({}, {"binding": 3}, "none"):
        save_checkpoint({"kind": kind, "trainer": trainer, "seconds": 0.0}, checkpoint)
        with pytest.raises(DataError, match="state: expected that of this fit"):
            fit([capture], tiny_rig(), tmp_path / "x.cap4d", preset=TINY, resume=True)
    remove_checkpoints(checkpoint)
    checkpoint.write_bytes(b"not a checkpoint")
    with pytest.raises(DataError, match="checkpoint: expected tensors"):
        fit([capture], tiny_rig(), tmp_path / "x.cap4d", preset=TINY, resume=True)


def test_a_checkpoint_that_executes_something_is_refused(capture, tmp_path):
    class Foreign:
        def __reduce__(self):
            return (print, ("executed",))

    save_checkpoint({"kind": Foreign()}, tmp_path / "x.fit.ckpt")
    with pytest.raises(DataError, match="checkpoint: expected tensors"):
        fit([capture], tiny_rig(), tmp_path / "x.cap4d", preset=TINY, resume=True)


def test_without_the_network_a_bundle_has_none(capture, tmp_path):
    output = tmp_path / "plain.cap4d"
    report = fit([capture], tiny_rig(), output, preset=replace(TINY, iterations=10), ablate="unet")
    assert report.ablate == "unet"
    bundle = read_bundle(output)
    assert bundle.deform_onnx is None
    assert not bundle.deform_neutral.any()


def test_on_the_rigs_own_triangles(capture, tmp_path):
    """Plain GaussianAvatars: another surface, no network, the same losses."""
    rig, output = tiny_rig(), tmp_path / "plain.cap4d"
    report = fit([capture], rig, output, preset=TINY, ablate="remesh")
    assert report.ablate == "remesh"
    assert report.held_out_psnr > report.nearest_frame_psnr + 2
    bundle = read_bundle(output)
    assert np.array_equal(bundle.grid.faces, rig.faces) and bundle.grid.is_mesh
    assert bundle.tiers == ("off",)
    assert np.unique(bundle.binding).size == len(rig.faces)  # none is left bare
    avatar = Avatar(bundle)
    moved = avatar.vertices(np.float32([1, 0])) - avatar.vertices(np.float32([0, 0]))
    np.testing.assert_allclose(moved, rig.expression_basis[0] * np.float32([1, -1, -1]), atol=1e-7)
    frames = [avatar.draw(avatar.idle.frame(t), avatar.camera) for t in (0, len(avatar.idle) // 2)]
    assert all(frame[..., 3].max() > 200 for frame in frames)


def test_captures_and_names_that_do_not_fit_are_refused(capture, tmp_path):
    output = tmp_path / "x.cap4d"
    with pytest.raises(DataError, match="rig_name: expected other, found tiny"):
        fit([capture], replace(tiny_rig(), name="other"), output, preset=TINY)
    with pytest.raises(ArgumentError, match="preset: expected one of"):
        fit([capture], tiny_rig(), output, preset="huge")
    with pytest.raises(ArgumentError, match="captures: expected at least one"):
        fit([], tiny_rig(), output, preset=TINY)
    with pytest.raises(ArgumentError, match="ablate"):
        fit([capture], tiny_rig(), output, preset=TINY, ablate="everything")
    assert not list(tmp_path.iterdir())
