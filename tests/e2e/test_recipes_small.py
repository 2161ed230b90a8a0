"""Fits by each recipe, tiny: the perceptual term, neck offsets, resets, and what the command line chooses."""

import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tiny_avatar import GRID, tiny_rig, write_tiny_capture
from tiny_vgg import write_tiny_vgg

from cap4d.avatar import fit as fit_module
from cap4d.avatar.fit import fit
from cap4d.avatar.losses import Perceptual
from cap4d.avatar.presets import PRESETS, Choices, Preset, preset_named
from cap4d.avatar.trainer import Trainer
from cap4d.capture.capture import Capture
from cap4d.cli import main
from cap4d.perceptual import lpips
from cap4d.rig.store import save_rig


def tiny(preset: Preset, *, steps: int = 12) -> Preset:
    d = replace(preset.densify, start=4, stop=10, every=3, split_scale=0.02)
    if d.reset_every:
        d = replace(d, reset_every=5)
    return replace(
        preset,
        iterations=steps,
        image_size=48,
        grid_size=GRID,
        deformer_width=4,
        gaussians=600,
        perceptual=replace(preset.perceptual, start=2, stop=6),
        densify=d,
    )


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "sheet"
    write_tiny_capture(path)
    return path


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch hub, and networks as narrow as the tests' files."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    monkeypatch.setattr(lpips, "PACKAGED", {})
    monkeypatch.setattr(fit_module, "load_lpips", partial(lpips.load_lpips, width=4))
    return tmp_path


@pytest.fixture
def fitted(capture, hub, monkeypatch):
    """Fits without writing an avatar."""
    monkeypatch.setattr(fit_module, "finish", lambda trainer, *_, **__: trainer)
    return partial(fit, [capture], tiny_rig(), hub / "x.cap4d")


def same(a: Trainer, b: Trainer) -> bool:
    pairs = zip(a.model.parameters(), b.model.parameters(), strict=True)
    return len(a.model) == len(b.model) and all(torch.equal(x, y) for x, y in pairs)


def test_without_weights_the_fit_says_so_once_and_leaves_lpips_out(fitted, caplog):
    preset = tiny(preset_named("debug", "released"))
    with caplog.at_level(logging.WARNING):
        missing = fitted(preset=preset)
    said = [r.getMessage() for r in caplog.records if "LPIPS" in r.getMessage()]
    assert len(said) == 1
    assert "https://" in said[0]
    assert same(missing, fitted(preset=Choices(perceptual="none").applied(preset)))


def test_with_weights_it_is_in_unless_it_is_ablated(fitted, hub):
    write_tiny_vgg(hub)
    preset = tiny(preset_named("debug", "released"))
    fits = {
        "fixed": (preset, None),
        "compat": (Choices(lpips_range="compat").applied(preset), None),
        "ablated": (preset, "lpips"),
        "none": (Choices(perceptual="none").applied(preset), None),
    }
    avatars = {
        name: fitted(preset=settings, ablate=ablate, lpips_weights=hub)
        for name, (settings, ablate) in fits.items()
    }
    assert same(avatars["ablated"], avatars["none"])
    assert not same(avatars["fixed"], avatars["none"])
    assert not same(avatars["fixed"], avatars["compat"])


def test_lpips_sees_images_in_the_range_that_was_chosen(hub):
    files = write_tiny_vgg(hub)
    network = lpips.load_lpips(files, width=4)
    image, target = torch.rand(2, 32, 32, 3, generator=torch.Generator().manual_seed(0))
    for image_range, expected in (
        ("fixed", network(2 * image - 1, 2 * target - 1)),
        ("compat", network(image, target)),
    ):
        term = replace(Perceptual.of("lpips", 0, 1), image_range=image_range)
        assert torch.equal(fit_module.distance_of(term, hub)(image, target), expected)


@pytest.mark.parametrize("recipe", ["released", "paper", "short"])
def test_every_recipe_learns(capture, fitted, recipe):
    preset = replace(tiny(preset_named("debug", recipe), steps=40), perceptual=Perceptual())
    losses = []

    def advance(trainer, step=Trainer.advance):
        losses.append(step(trainer))
        return losses[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "advance", advance)
        trainer = fitted(preset=preset)
    assert np.mean(losses[-5:]) < 0.95 * np.mean(losses[11:16])  # after the last reset of opacities, if any
    tracked = Capture.load(capture)
    turned = np.abs(trainer.corrections[0].corrected(tracked.clip()).neck_rot - tracked.neck_rot).max(1)
    if recipe == "released":  # offsets of trained frames are kept, held-out frames have none
        assert (np.delete(turned, [9, 19, 22, 23]) > 0).sum() > 10
        assert not turned[[9, 19, 22, 23]].any()
    if recipe == "paper":
        assert not turned.any()


def test_pruning_by_contribution_keeps_the_budget(fitted):
    preset = tiny(PRESETS["debug"])
    preset = replace(preset, densify=replace(preset.densify, most=700))
    plain, pruned = fitted(preset=preset), fitted(preset=Choices(prune="contribution").applied(preset))
    assert 600 < len(plain.model) == len(pruned.model) <= 700
    assert not same(plain, pruned)


def test_the_command_line_chooses(capture, hub, monkeypatch):
    rig = hub / "rig.npz"
    save_rig(tiny_rig(), rig)
    seen = {}
    monkeypatch.setattr(fit_module, "fit", lambda *_, **settings: seen.update(settings))
    base = ["fit", str(capture), "--rig", str(rig), "-o", str(hub / "x.cap4d")]
    main([*base, "--preset", "medium"])
    assert seen["preset"] == PRESETS["medium"]  # auto, without a CUDA device
    main([*base, "--recipe", "released", "--split-offset", "local", "--per-face", "0", "--ablate", "lpips"])
    expected = Choices(split_offset="local", per_face=0).applied(preset_named("low", "released"))
    assert (seen["preset"], seen["ablate"]) == (expected, "lpips")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    main([*base, "--lpips-weights", str(hub), "--perceptual", "gradient", "--prune", "contribution"])
    expected = Choices(perceptual="gradient", prune="contribution").applied(preset_named("low", "released"))
    assert (seen["preset"], seen["lpips_weights"]) == (expected, hub)
