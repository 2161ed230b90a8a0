"""Which form of the network plays: what is asked for, what the file has, what the machine keeps up with."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import tiny_bundle

from cap4d import cli
from cap4d.bundle import Bundle
from cap4d.bundle.onnx_half import halve_weights
from cap4d.errors import ArgumentError
from cap4d.player import tiers
from cap4d.player.avatar import Avatar, Tier
from cap4d.player.deformer import Deformer
from cap4d.player.offline import statistics

SMILE = np.float32([0.2, 0, 0, 1, 0])  # of tiny_bundle's five expressions


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    """With a network, and with lines that push the deformable part 1 mm forward for a smile."""
    bundle = tiny_bundle()
    linear = np.zeros_like(bundle.subject.expression_basis)
    linear[3, bundle.grid.deformable, 2] = 1e-3
    return replace(bundle, deform_linear=linear, tier_errors={"linear": (0.25, 1.5)})


def test_the_file_decides_what_there_is(bundle: Bundle) -> None:
    assert bundle.tiers == ("full", "linear", "off")
    half = replace(bundle, deform_onnx=halve_weights(bundle.deform_onnx), deform_int8={"w": np.zeros(1)})
    assert half.tiers == ("fp16", "int8", "linear", "off")
    assert replace(bundle, deform_onnx=None).tiers == ("linear", "off")


@pytest.mark.parametrize("tier", ["full", "linear", "off"])
def test_what_is_asked_for_plays(tier: str, bundle: Bundle) -> None:
    avatar = Avatar(bundle, deformer=tier)
    assert avatar.tier == tier and (avatar.deformer is not None) == (tier == "full")


def test_half_weights_answer_nearly_alike(bundle: Bundle) -> None:
    half = Avatar(replace(bundle, deform_onnx=halve_weights(bundle.deform_onnx)), deformer="fp16")
    difference = np.abs(half.vertices(SMILE) - Avatar(bundle, deformer="full").vertices(SMILE)).max()
    assert 0 < difference < 2e-5


def test_lines_are_part_of_the_expression_and_turn_with_the_skin(bundle: Bundle) -> None:
    linear, off = (Avatar(bundle, deformer=tier) for tier in ("linear", "off"))
    moved = linear.vertices(SMILE) - off.vertices(SMILE)
    assert not moved[~bundle.grid.deformable].any()
    still = bundle.grid.deformable & (bundle.subject.skin_weights.max(1) < 0.01)
    assert still.any()
    np.testing.assert_allclose(moved[still], np.tile([0, 0, -1e-3], (still.sum(), 1)), atol=5e-6)
    neck = np.float32([0.4, 0, 0])
    bends = bundle.grid.deformable & (bundle.subject.skin_weights[:, 0] > 0.05)
    bent = linear.vertices(SMILE, neck_rot=neck) - off.vertices(SMILE, neck_rot=neck)
    assert np.abs(bent - moved)[bends, 1].min() > 1e-5
    np.testing.assert_array_equal(linear.vertices(0 * SMILE), off.vertices(0 * SMILE))


def test_a_tier_that_is_not_there_is_one_line_that_names_those_that_are(bundle: Bundle) -> None:
    with pytest.raises(
        ArgumentError, match=r"deformer: expected one that a\.cap4d has \(full, linear, off, or"
    ):
        Avatar(bundle, deformer="int8", source="a.cap4d")
    with pytest.raises(ArgumentError, match="deformer: expected one of auto, full, fp16, int8, linear, off"):
        Avatar(bundle, deformer="int4")


@pytest.mark.parametrize(
    ("milliseconds", "budget", "chosen"),
    [(5.0, 8.0, "full"), (9.0, 8.0, "int8"), (9.0, math.inf, "full"), (900.0, 8.0, "int8")],
)
def test_auto_takes_the_most_exact_that_keeps_up(
    milliseconds: float, budget: float, chosen: str, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = replace(bundle, deform_int8={"weights": np.zeros(4, np.int8)})
    monkeypatch.setattr(Deformer, "milliseconds", lambda self: milliseconds)
    monkeypatch.setattr("cap4d.player.deformer._quantized_network", lambda *_: lambda offsets, answer: None)
    assert Avatar(both, deformer_budget_ms=budget).tier == chosen


def test_auto_without_a_choice(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(self: Deformer) -> float:
        raise AssertionError("one network is not worth timing")

    monkeypatch.setattr(Deformer, "milliseconds", slow)
    assert Avatar(bundle).tier == "full", "a network that is slow is better than lines"
    assert Avatar(replace(bundle, deform_onnx=None)).tier == "linear"
    assert Avatar(replace(bundle, deform_onnx=None, deform_linear=None)).tier == "off"


def test_timing_a_pass_leaves_no_trace(bundle: Bundle) -> None:
    deformer = Deformer(bundle.deform_onnx, size=bundle.grid.size)
    offsets = np.full(deformer.shape, 1e-3, np.float32)
    before = deformer(offsets).copy()
    assert deformer.milliseconds() > 0 and deformer.passes == 1
    np.testing.assert_array_equal(deformer(offsets), before)


def test_statistics_say_which_and_how_far_off(bundle: Bundle) -> None:
    stats = statistics(Avatar(bundle, deformer="linear"), 1, 1.0, size=(8, 8), backend="cpu")
    assert stats["deformer"] == "linear"
    assert stats["tier_errors"] == {"linear": {"rms_mm": 0.25, "max_mm": 1.5}}


def test_every_command_line_offers_every_tier() -> None:
    options = pytest.importorskip("cap4d.app.options")
    assert options.DEFORMERS == tiers.CHOICES == get_args(Tier)
    render = cli.build_parser()._subparsers._group_actions[0].choices["render"]
    (action,) = (a for a in render._actions if a.dest == "deformer")
    assert tuple(action.choices) == tiers.CHOICES
