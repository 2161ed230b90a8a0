"""What all metrics have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from cap4d.evaluate.pair import Pair

Better = Literal["higher", "lower"]


class Metric(Protocol):
    """A number for every pair of images; its class's docstring is its definition and says where it is from.

    `decimals` of it are worth printing.
    """

    name: str
    unit: str
    better: Better
    decimals: int

    def measure(self, pair: Pair) -> float | None:
        """None where what it looks at (a face, an open eye) is not to be seen in both images."""


@dataclass(frozen=True)
class NotMeasured:
    """A metric that cannot be had here. `needs`: what is missing, and how to get it."""

    name: str
    needs: str
