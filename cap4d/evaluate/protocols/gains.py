"""Whether one row of a table is really better than another: paired differences, view by view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cap4d.evaluate.protocols.cell import Result

HIGHER = frozenset({"PSNR", "PSNR-fg", "SSIM", "CSIM", "JOD"})
"""Metrics of which more is better; of all others less is."""


@dataclass(frozen=True)
class Gain:
    """How much better one way is than another, positive where it is.

    Args:
        metric: Of it.
        identities: Per identity, the mean of the paired differences of its views.
        errors: Per identity, the standard error of that mean over its views (which are not independent: they
            share an avatar; None for a single view).
    """

    metric: str
    identities: dict[str, float]
    errors: dict[str, float | None]

    @property
    def mean(self) -> float:
        """Over identities."""
        return float(np.mean(list(self.identities.values())))

    @property
    def error(self) -> float | None:
        """Standard error of the mean over identities, which are independent; None for one."""
        return standard_error(list(self.identities.values()))

    @property
    def better(self) -> int:
        """Identities for which it is better."""
        return sum(value > 0 for value in self.identities.values())

    def document(self) -> dict:
        return {
            "mean": self.mean,
            "standard_error": self.error,
            "better_for": self.better,
            "identities": {n: [v, self.errors[n]] for n, v in self.identities.items()},
        }


def gain(metric: str, ours: Sequence[Result], theirs: Sequence[Result]) -> Gain | None:
    """Of `ours` over `theirs`, whose cells differ in one thing; None where no view has both numbers.

    Only identities, and of these only views, that both have count.
    """
    sign = 1.0 if metric in HIGHER else -1.0
    others = {r.cell.identity: r for r in theirs}
    means, errors = {}, {}
    for mine in ours:
        other = others.get(mine.cell.identity)
        if other is None or metric not in mine.values or metric not in other.values:
            continue
        apart = sign * (mine.values[metric] - other.values[metric])
        apart = apart[np.isfinite(apart)]
        if len(apart):
            means[mine.cell.identity] = float(apart.mean())
            errors[mine.cell.identity] = standard_error(apart)
    return Gain(metric, means, errors) if means else None


def standard_error(values: Sequence[float] | np.ndarray) -> float | None:
    """Of the mean of values; None for fewer than two."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
