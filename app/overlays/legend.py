"""What an overlay's colours mean."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

STEPS = 1.0, 1.2, 1.6, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0  # whose quarters are short


@dataclass(frozen=True, eq=False)
class Legend:
    """A colour bar.

    Args:
        title: With the unit.
        colors: uint8[C, 3] from the left end to the right.
        ticks: (share of the bar's length, text), left to right.
    """

    title: str
    colors: np.ndarray
    ticks: tuple[tuple[float, str], ...]


def ticks(limit: float) -> tuple[tuple[float, str], ...]:
    """0, quarters, and `limit`, which stands for what is beyond it too."""
    texts = [f"{limit * k / 4:.3g}" for k in range(4)]
    return (*((k / 4, text) for k, text in enumerate(texts)), (1.0, f"{limit:.3g}+"))


def rounded_up(value: float) -> float:
    """The next of `STEPS` times a power of ten: a limit that stays while values move a little."""
    if not value > 0:
        return STEPS[0]
    power = 10.0 ** math.floor(math.log10(value))
    return next((step * power for step in STEPS if step * power >= value * (1 - 1e-6)), 10 * power)
