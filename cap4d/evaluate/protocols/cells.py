"""Works through the cells of a protocol: one that fails does not lose the others."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from cap4d.errors import Cap4dError, DataError

log = logging.getLogger(__name__)

T = TypeVar("T")
QUICK = 1.0  # s; a cell that took less was found done and says nothing of the pace


@dataclass(frozen=True)
class Failure:
    """A cell that came to nothing, and why, in one line."""

    name: str
    reason: str


def run_cells(
    jobs: Sequence[tuple[str, Callable[[], T]]], *, after: Callable[[list[T], list[Failure]], None]
) -> tuple[list[T], list[Failure]]:
    """Does the jobs in order.

    Args:
        jobs: Each cell's name, and what makes it or finds it made.
        after: Called after every cell with all that is known so far.
    """
    results: list[T] = []
    failures: list[Failure] = []
    times: list[float] = []
    for i, (name, job) in enumerate(jobs):
        log.info("cell %d/%d: %s%s", i + 1, len(jobs), name, _left(times, len(jobs) - i))
        begun = time.monotonic()
        try:
            results.append(job())
        except Exception as error:  # hours of other cells are at stake, whatever went wrong in this one
            failures.append(Failure(name, _line(error)))
            log.error("%s failed: %s", name, failures[-1].reason)
            log.debug("its traceback", exc_info=True)
        seconds = time.monotonic() - begun
        times += [seconds] if seconds > QUICK else []
        after(results, failures)
    return results, failures


def check_whole(report: Path, count: int, failures: Sequence[Failure]) -> None:
    """
    Raises:
        DataError: Some of `count` cells failed; the report has the others.
    """
    if failures:
        found = "failed: " + "; ".join(f"{f.name}: {f.reason}" for f in failures)
        raise DataError(report, "cells", expected=f"all of {count}", found=found)


def _left(times: Sequence[float], cells: int) -> str:
    """What the cells so far say of those to come; nothing before the first."""
    if not times:
        return ""
    seconds = int(sum(times) / len(times) * cells)
    return f", about {seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"


def _line(error: Exception) -> str:
    text = " ".join(str(error).split())[:300]
    return text if isinstance(error, Cap4dError) else f"{type(error).__name__}: {text}"
