"""Between FLAME's editions: exact within one, refused with a reason between two."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d.drive.flame_editions import convert_expression, same_basis
from cap4d.drive.packet import Cause, Rejected

NAMES = (*(f"expr{i:02d}" for i in range(64)), "blink")
RNG = np.random.default_rng(0)


def draw(n: int) -> np.ndarray:
    return RNG.normal(size=n).astype(np.float32)


def test_the_same_length_passes_untouched() -> None:
    expr = draw(65)
    assert convert_expression(expr, "flame2023_no_jaw", "flame2023_no_jaw", NAMES) is expr


@pytest.mark.parametrize("n", [10, 50, 64, 100])
def test_more_or_fewer_components_of_the_same_edition(n: int) -> None:
    expr = draw(n)
    found = convert_expression(expr, "generic_model", "flame2020", NAMES)
    shared = min(n, 64)
    assert np.array_equal(found[:shared], expr[:shared]) and not found[shared:].any(), (
        "no blink out of a component"
    )


def test_the_released_systems_blink_is_no_component() -> None:
    bare = tuple(f"expr{i:02d}" for i in range(100))
    found = convert_expression(draw(65), "flame2023_no_jaw", "flame2023_no_jaw", bare)
    assert found.shape == (100,) and found[:64].all() and not found[64:].any()


@pytest.mark.parametrize("target", ["flame2023", "flame2023_no_jaw"])
def test_another_basis_is_refused_and_says_what_to_send(target: str) -> None:
    with pytest.raises(Rejected, match=f"{target}, got flame2020.*send vertices") as caught:
        convert_expression(draw(65), "flame2020", target, NAMES)
    assert caught.value.cause == Cause.RIG


def test_lengths_that_no_edition_has_are_refused() -> None:
    for n in (0, 101, 5000):
        with pytest.raises(Rejected) as caught:
            convert_expression(draw(n), "flame2020", "flame2020", NAMES)
        assert caught.value.cause == Cause.SHAPE


def test_same_basis() -> None:
    assert same_basis("builtin", "builtin") and same_basis("generic_model", "flame2020")
    assert not same_basis("flame2020", "flame2023") and not same_basis("flame2023", "flame2023_no_jaw")
