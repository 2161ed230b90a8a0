"""What overlays mean: legends, colours, and the deformation behind them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnx")

from dataclasses import replace

from cap4d.app.overlays.color_map import color_map
from cap4d.app.overlays.legend import rounded_up, ticks
from tiny_bundle import tiny_bundle

from cap4d.player.avatar import Avatar


@pytest.mark.parametrize("name", ["viridis", "magma"])
def test_lighter_is_more(name: str) -> None:
    colors = color_map(name)
    assert colors.shape == (17, 3) and colors.dtype == np.uint8
    lightness = colors @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 2).all() and lightness[0] < 30 and lightness[-1] > 210


def test_colours_are_those_of_matplotlib() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    at = np.linspace(0, 1, 256)
    for name in ("viridis", "magma"):
        ours = np.stack([np.interp(at, np.linspace(0, 1, 17), c) for c in color_map(name).T / 255], -1)
        assert np.abs(ours - matplotlib.colormaps[name](at)[:, :3]).max() < 0.025


@pytest.mark.parametrize(
    ("value", "limit"),
    [
        (0.0, 1),
        (float("nan"), 1),
        (-3, 1),
        (0.011, 0.015),
        (1, 1),
        (1.2, 1.5),
        (30, 30),
        (71, 100),
        (2999, 3000),
    ],
)
def test_limits_are_round(value: float, limit: float) -> None:
    assert rounded_up(value) == pytest.approx(limit)


def test_the_last_tick_stands_for_what_is_beyond() -> None:
    assert ticks(2.0) == ((0.0, "0"), (0.25, "0.5"), (0.5, "1"), (0.75, "1.5"), (1.0, "2+"))


def test_deformation_is_what_the_network_moved() -> None:
    bundle = tiny_bundle(12)
    with_network, without = Avatar(bundle, deformer="full"), Avatar(bundle, deformer="off")
    for index in (0, 3, 7):
        frame = bundle.idle.frame(index)
        moved = with_network.move(frame) - (without.move(frame) - bundle.deform_neutral)
        np.testing.assert_allclose(with_network.deformation(), moved, atol=2e-7)
        np.testing.assert_array_equal(without.deformation(), bundle.deform_neutral)
    assert np.abs(with_network.deformation() - bundle.deform_neutral).max() > 1e-5


def test_deformation_is_what_stands_in_for_the_network() -> None:
    bundle = tiny_bundle(12, network=False)
    shape = (bundle.n_expressions, *bundle.subject.neutral.shape)
    linear = 1e-3 * np.random.default_rng(0).normal(size=shape).astype(np.float32)
    linear[:, ~bundle.grid.deformable] = 0
    bundle = replace(bundle, deform_linear=linear)
    expr = bundle.idle.frame(4).expr
    # at rest: what the joints turn turns with them
    still = replace(bundle, subject=replace(bundle.subject, expr_rotation=None))
    tiers = {tier: Avatar(still, deformer=tier) for tier in ("linear", "off")}
    vertices = {tier: avatar.vertices(expr) for tier, avatar in tiers.items()}
    moved = vertices["linear"] - vertices["off"] + bundle.deform_neutral
    np.testing.assert_allclose(tiers["linear"].deformation(), moved, atol=2e-7)
    assert np.abs(moved).max() > 1e-4


def test_asking_for_it_changes_nothing() -> None:
    avatar = Avatar(tiny_bundle(12))
    frame = avatar.idle.frame(2)
    before = avatar.move(frame).copy()
    avatar.deformation()[:] = 7
    np.testing.assert_array_equal(avatar.move(frame), before)
