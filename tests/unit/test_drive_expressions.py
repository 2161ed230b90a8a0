"""Expressions by name, range and group."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import EXPRESSIONS, tiny_bundle

from cap4d.drive.expressions import GROUPS, expression_groups, expression_names, expression_ranges
from cap4d.rig.head import HeadRig


def test_names_and_ranges_are_the_bundles() -> None:
    bundle = tiny_bundle(8, network=False)
    assert expression_names(bundle) == EXPRESSIONS
    ranges = expression_ranges(bundle)
    assert ranges.shape == (len(EXPRESSIONS), 2) and ranges.dtype == np.float32
    assert (ranges[:, 0] <= 0).all() and (ranges[:, 1] > 0).all()


def test_every_expression_is_in_one_group(builtin_rig: HeadRig) -> None:
    rig = SimpleNamespace(subject=builtin_rig)
    groups = expression_groups(rig)
    assert set(groups) == set(GROUPS)
    assert sorted(number for group in groups.values() for number in group) == list(range(52))
    brows = [builtin_rig.expression_names[number] for number in groups["brows"]]
    assert brows == ["browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight"]


def test_names_that_say_nothing_are_shapes() -> None:
    flame = SimpleNamespace(subject=SimpleNamespace(expression_names=("expr00", "expr01", "blink")))
    assert expression_groups(flame) == {"eyes": (2,), "shapes": (0, 1)}
