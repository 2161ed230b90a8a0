"""Expressions as people look for them."""

import numpy as np
import pytest
from cap4d.app.expressions import OTHER, group_of, grouped, label, listed, matching

NAMES = (
    "mouthSmile_L",
    "browInnerUp",
    "eyeBlinkLeft",
    "expr07",
    "blink",
    "jawOpen",
    "tongueOut",
    "noseSneer_R",
)
RANGES = np.tile(np.float32([0, 1]), (len(NAMES), 1))


@pytest.mark.parametrize(
    ("name", "group", "text"),
    [
        ("mouthSmile_L", "Mouth", "Mouth smile left"),
        ("browInnerUp", "Brows", "Brow inner up"),
        ("eyeBlinkRight", "Eyes", "Eye blink right"),
        ("blink", "Eyes", "Blink"),
        ("cheekPuff", "Cheeks and nose", "Cheek puff"),
        ("jawOpen", "Jaw", "Jaw open"),
        ("tongueOut", "Tongue", "Tongue out"),
        ("expr07", OTHER, "Expression 7"),
        ("\u2603", OTHER, "\u2603"),
    ],
)
def test_groups_and_labels(name, group, text):
    assert (group_of(name), label(name)) == (group, text)


def test_they_stand_group_by_group_and_know_their_place_in_the_vector():
    found = listed(NAMES, RANGES)
    assert [e.name for e in found][:3] == ["browInnerUp", "eyeBlinkLeft", "blink"]
    assert found[-1].group == OTHER
    assert all(NAMES[e.index] == e.name for e in found)
    assert list(grouped(found)) == ["Brows", "Eyes", "Cheeks and nose", "Jaw", "Mouth", "Tongue", OTHER]


def test_an_empty_range_becomes_one_that_a_bar_can_have():
    (only,) = listed(["a"], np.float32([[1, 1]]))
    assert (only.low, only.high) == (1, 2)


def test_a_search_finds_by_name_label_and_group_whatever_the_case():
    found = listed(NAMES, RANGES)
    assert [e.name for e in matching(found, "SMILE left")] == ["mouthSmile_L"]
    assert [e.name for e in matching(found, "cheeks")] == ["noseSneer_R"]
    assert matching(found, "  ") == found
    assert matching(found, "zzz") == []
