"""Expressions as people look for them."""

from dataclasses import replace

import numpy as np
import pytest
from cap4d.app.expressions import grouped, label, listed, matching
from tiny_bundle import tiny_bundle


@pytest.fixture(scope="module")
def bundle():
    return tiny_bundle(network=False)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("mouthSmile_L", "Mouth smile left"),
        ("browInnerUp", "Brow inner up"),
        ("eyeBlinkRight", "Eye blink right"),
        ("expr07", "Expression 7"),
        ("\u2603", "\u2603"),
    ],
)
def test_labels_are_words(name, text):
    assert label(name) == text


def test_they_stand_group_by_group_and_know_their_place_in_the_vector(bundle):
    found = listed(bundle)
    assert [e.name for e in found][:3] == ["browInnerUp", "eyeBlinkLeft", "eyeBlinkRight"]
    assert all(bundle.subject.expression_names[e.index] == e.name for e in found)
    assert list(grouped(found)) == ["Brows", "Eyes", "Jaw", "Mouth"]


def test_an_empty_range_becomes_one_that_a_bar_can_have(bundle):
    flat = replace(bundle, expression_range=np.ones_like(bundle.expression_range))
    assert {(e.low, e.high) for e in listed(flat)} == {(1, 2)}


def test_a_search_finds_by_name_label_and_group_whatever_the_case(bundle):
    found = listed(bundle)
    assert [e.name for e in matching(found, "SMILE left")] == ["mouthSmileLeft"]
    assert [e.name for e in matching(found, "eyes")] == ["eyeBlinkLeft", "eyeBlinkRight"]
    assert matching(found, "  ") == found
    assert matching(found, "zzz") == []
