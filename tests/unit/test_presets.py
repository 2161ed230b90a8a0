"""Every constant of the recipes, written down twice: facts 26-38, and what the paper does otherwise."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_avatar import GRID, tiny_avatar, tiny_rig

from cap4d.avatar.losses import Perceptual
from cap4d.avatar.model import initial_counts, initial_gaussians
from cap4d.avatar.presets import (
    PRESET_NAMES,
    PRESETS,
    RECIPE_NAMES,
    Choices,
    Densify,
    LearningRates,
    preset_named,
)
from cap4d.avatar.trainer import Trainer
from cap4d.errors import ArgumentError
from cap4d.rig.grid import build_grid

# Fact 37's table: steps, densify from, until, every, opacity reset, LPIPS ramp, first Gaussians.
TABLE = {
    "default": (100_000, 8_000, 70_000, 2_000, 20_000, 10_000, 60_000, 100_000),
    "medium": (50_000, 4_000, 40_000, 2_000, 10_000, 5_000, 40_000, 50_000),
    "low": (25_000, 2_000, 24_000, 1_000, 10_000, 4_000, 24_000, 25_000),
    "debug": (1_000, 80, 700, 200, 200, 100, 600, 100_000),
}


@pytest.fixture(params=PRESET_NAMES)
def released(request):
    return preset_named(request.param, "released")


def test_schedules(released):
    d, p = released.densify, released.perceptual
    row = (released.iterations, d.start, d.stop, d.every, d.reset_every, p.start, p.stop, released.gaussians)
    assert row == TABLE[released.name]


def test_gaussians_and_images(released):
    assert (released.sh_degree, released.sh_every) == (3, 1000)  # facts 26, 37
    assert (released.per_face, released.paint) == (2, False)  # fact 29
    assert (released.image_size, released.grid_size) == (512, 128)  # facts 16, 42
    assert released.deformer_width == 64  # fact 22
    assert (released.expression_noise, released.rotation_every) == (0.0, 1)


def test_densification(released):
    d = released.densify
    assert (d.gradient, d.most) == (1e-6, None)
    assert (d.split_scale, d.prune_opacity) == (0.01, 0.005)  # percent_dense 0.01 of an extent of 1
    assert (d.prune_big_after, d.prune_radius, d.prune_scale) == (d.reset_every, math.inf, 0.1)
    assert (d.split_offset, d.prune_least) == ("world", 0.0)  # fact 30


def test_losses(released):
    w, p = released.weights, released.perceptual
    assert (w.l1, w.dssim, w.l2, w.matte) == (0.6, 0.4, 0.0, 0.0)  # fact 33
    assert (p.kind, p.weight, p.most, p.image_range) == ("lpips", 0.1, 0.9, "fixed")
    assert (w.position, w.position_limit, w.scale, w.scale_limit) == (1e-3, 2.0, 1.0, 1.0)  # fact 34
    assert (w.laplacian, w.deformation, w.rotation, w.pose) == (1.0, 0.4, 0.005, 1.0)  # fact 35
    assert w.measures == "released"
    assert released.corrections == "neck"  # fact 32


def test_rates(released):
    r = released.rates  # fact 36
    assert (r.means, r.deformer, r.correction) == ((5e-3, 5e-5), (1e-5, 1e-7), (1e-5, 1e-7))
    assert (r.sh_dc, r.sh_rest) == ((2.5e-3, 2.5e-3), (2.5e-3 / 20, 2.5e-3 / 20))
    assert (r.opacity, r.scale, r.rotation) == ((0.025, 0.025), (0.005, 0.005), (1e-3, 1e-3))
    assert (r.deformer_decay, r.gaussian_eps, r.correction_eps) == (2e-3, 1e-15, 1e-18)


@pytest.mark.parametrize("name", PRESET_NAMES)
def test_the_paper_differs_where_it_says_so_and_nowhere_else(name):
    code, paper = preset_named(name, "released"), preset_named(name, "paper")
    assert (paper.weights.l1, paper.weights.dssim, paper.weights.laplacian) == (0.8, 0.2, 0.0)
    assert (paper.perceptual.weight, paper.corrections) == (1.0, "none")
    assert paper.densify.split_offset == "local"
    back = replace(
        paper,
        recipe="released",
        corrections="neck",
        weights=code.weights,
        perceptual=code.perceptual,
        densify=code.densify,
    )
    assert back == code
    assert replace(paper.weights, l1=0.6, dssim=0.4, laplacian=1.0) == code.weights
    assert replace(paper.perceptual, weight=0.1) == code.perceptual


def test_opacities_are_reset_at_the_first_growth_and_every_20k():
    d = preset_named("default", "released").densify
    assert [s for s in range(1, 100_001) if d.resets_at(s)] == [8_000, 20_000, 40_000, 60_000]
    assert [s for s in range(1, 100_001) if d.grows_at(s)] == list(range(10_000, 69_000, 2_000))
    medium = preset_named("medium", "released").densify
    assert [s for s in range(1, 50_001) if medium.resets_at(s)] == [4_000, 10_000, 20_000, 30_000]
    assert [s for s in range(200) if Densify(start=10, stop=30, every=10).grows_at(s)] == [10, 20, 30]
    assert not any(Densify(start=10, stop=100, every=10).resets_at(s) for s in range(200))


def test_the_share_of_lpips_rises_from_10k_to_60k_and_stays():
    p = preset_named("default", "released").perceptual
    shares = [p.share(s) for s in (0, 10_000, 35_000, 60_000, 100_000)]
    assert shares == pytest.approx([0, 0, 0.45, 0.9, 0.9])
    assert Perceptual().share(10**9) == 0


def test_rates_fall_log_linearly_without_a_warm_up():
    preset = replace(preset_named("default", "released"), iterations=100, sh_degree=1)
    trainer = Trainer(tiny_avatar(tiny_rig()), [], [], preset, seed=0)
    decays = {group.get("weight_decay") for group in trainer.optimizer.param_groups}
    assert decays == {0, 2e-3}
    for step, share in ((0, 0.0), (50, 0.5), (100, 1.0)):
        trainer.step = step
        trainer._set_rates()
        found = {
            round(math.log10(g["lr"]), 6) for g in trainer.optimizer.param_groups if g["ends"][0] == 1e-5
        }
        assert found == {round(-5 - 2 * share, 6)}
        positions = [g["lr"] for g in trainer.optimizer.param_groups if g["ends"] == (5e-3, 5e-5)]
        assert positions == [pytest.approx(5e-3 * 100**-share)]


def test_the_first_gaussians():
    """Fact 29: in proportion to area, at least two; 1 / count wide, a tenth opaque, grey."""
    rig = tiny_rig()
    grid = build_grid(rig, GRID)
    counts = initial_counts(rig, grid, gaussians=1_000, per_face=2)
    assert counts.min() >= 2
    free = initial_counts(rig, grid, gaussians=100_000, per_face=0)
    assert abs(free.sum() - 100_000) <= 1
    floored = initial_counts(rig, grid, gaussians=100_000, per_face=2)
    assert np.abs(floored - np.maximum(free, 2)).max() <= 1
    sparse = initial_counts(rig, grid, gaussians=90, per_face=0)
    assert sparse.sum() in (89, 90, 91)
    assert sparse.max() == 1
    few, owners = initial_gaussians(sparse, sh_degree=0, generator=torch.Generator().manual_seed(0))
    assert owners.tolist() == np.flatnonzero(sparse).tolist()
    covering = torch.full((len(owners), 3), (len(sparse) / len(owners)) ** 0.5)
    torch.testing.assert_close(few["log_scales"].exp(), covering)
    local, binding = initial_gaussians(counts, sh_degree=3, generator=torch.Generator().manual_seed(0))
    n = len(binding)
    assert {k: tuple(v.shape[1:]) for k, v in local.items()} == {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "opacity_logits": (),
        "sh_dc": (1, 3),
        "sh_rest": (15, 3),
    }
    assert 0 <= local["means"].min() < 0.01
    assert 0.39 < local["means"].max() < 0.4
    torch.testing.assert_close(local["log_scales"].exp()[:, 0], 1 / torch.from_numpy(counts)[binding].float())
    torch.testing.assert_close(local["opacity_logits"].sigmoid(), torch.full((n,), 0.1))
    assert 0 <= local["sh_dc"].min() <= local["sh_dc"].max() < 1 / 255
    assert not local["sh_rest"].any()
    assert local["quats"].unique(dim=0).tolist() == [[1, 0, 0, 0]]


def test_the_short_schedules_are_those_that_were_measured():
    debug, low = PRESETS["debug"], PRESETS["low"]
    assert (debug.iterations, debug.gaussians, debug.densify.most) == (500, 30_000, 50_000)
    assert (low.iterations, low.gaussians, low.densify.most) == (2_500, 40_000, 90_000)
    for preset in PRESETS.values():
        assert preset.recipe == "short"
        assert preset.rates.gaussian_eps == (1e-8 if preset.name == "debug" else 1e-7)
        assert preset.perceptual == Perceptual()
        assert (preset.weights.l2, preset.weights.position, preset.weights.position_limit) == (5.0, 1e-2, 0.7)
        assert preset.corrections == "auto"


def test_unknown_names_are_refused():
    for recipe in RECIPE_NAMES:
        assert [preset_named(n, recipe).name for n in PRESET_NAMES] == list(PRESET_NAMES)
        assert preset_named("low", recipe).recipe == recipe
    with pytest.raises(ArgumentError, match="recipe: expected one of released, paper, short, got 'best'"):
        preset_named("low", "best")
    with pytest.raises(ArgumentError, match=r"preset: expected one of .*, got 'huge'"):
        preset_named("huge")


def test_choices():
    low, released = preset_named("low"), preset_named("low", "released")
    assert Choices().applied(low) == low
    assert Choices().applied(released) == released
    chosen = Choices(per_face=0, split_offset="local", prune="contribution", perceptual="none")
    changed = chosen.applied(released)
    assert changed.weights == replace(released.weights, scale_limit=3.0)
    assert (changed.per_face, changed.densify.split_offset, changed.densify.prune_least) == (0, "local", 0.05)
    assert changed.perceptual.kind == "none"
    assert changed.rates == LearningRates()
    gradient = Choices(perceptual="gradient").applied(low).perceptual
    assert (gradient.kind, gradient.start, gradient.stop) == ("gradient", 250, 1_500)
    ramp = Choices(perceptual="gradient").applied(released).perceptual
    assert (ramp.start, ramp.stop) == (4_000, 24_000)
    assert Choices(lpips_range="compat").applied(released).perceptual.image_range == "compat"
