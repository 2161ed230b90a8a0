"""How a cell's avatar is judged: by `cap4d evaluate`'s metrics, on the cell's views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cap4d.errors import ArgumentError
from cap4d.evaluate.evaluate import evaluate
from cap4d.evaluate.metrics.metric import NotMeasured
from cap4d.evaluate.metrics.registry import METRIC_NAMES, metrics_available
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.protocols.cell import Judge, Views

OPTIONAL = frozenset({"LPIPS", "CSIM", "JOD", "AED", "APD", "AKD-fan"})
"""Metrics that weights or a package may bring; cells that were judged without them are judged again."""


def judge_by_metrics(weights: Weights, only: Sequence[str] | None = None) -> tuple[Judge, str]:
    """A judge, and what tells it from one with other weights or metrics.

    Args:
        only: Names of metrics; None: all.
    Raises:
        ArgumentError: An unknown metric, or a missing file: known here, not after hours of fits.
        DataError: A file is no such network.
    """
    files = {k: None if p is None else (str(p), _size(p)) for k, p in vars(weights).items()}
    found = metrics_available(weights, only=only)
    had = [m.name for m in found if m.name in OPTIONAL and not isinstance(m, NotMeasured)]

    def judge(avatar: Path, capture: Path, views: Views, size: int, pictures: Path):
        found = evaluate(
            avatar, capture, views=views, weights=weights, only=only, size=size, pictures=pictures
        )
        if list(found.views) != [tuple(v) for v in views]:
            raise AssertionError("evaluate answered for other views than it was asked for")
        missing = {name: m.needs for name, m in found.missing.items()}
        measured = [n for n in only or METRIC_NAMES if n not in missing]
        return {n: found.values(n) for n in measured}, missing

    return judge, repr((files, only, *had))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise ArgumentError(f"{path}: cannot be read: {error.strerror}") from error
