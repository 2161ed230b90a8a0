"""Works through the cells of a protocol: those done are kept, one that fails does not lose the others."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cap4d.errors import Cap4dError
from cap4d.evaluate.protocols.cell import Cell, Judge, Result, run_cell

log = logging.getLogger(__name__)

QUICK = 1.0  # s; a cell that took less was found done and says nothing of the pace


@dataclass(frozen=True)
class Failure:
    """A cell that came to nothing, and why, in one line."""

    cell: Cell
    reason: str


def run_cells(
    cells: Sequence[Cell],
    rig: Path,
    folder: Path,
    judge: Judge,
    judged_by: str,
    *,
    after: Callable[[list[Result], list[Failure]], None],
) -> tuple[list[Result], list[Failure]]:
    """Runs the cells in order.

    Args:
        folder: Of all cells.
        judge, judged_by: See `run_cell`.
        after: Called after every cell with all that is known so far.
    """
    results: list[Result] = []
    failures: list[Failure] = []
    times: list[float] = []
    for i, cell in enumerate(cells):
        log.info("cell %d/%d: %s%s", i + 1, len(cells), cell.name, _left(times, len(cells) - i))
        begun = time.monotonic()
        try:
            results.append(run_cell(cell, rig, folder, judge, judged_by))
        except Exception as error:  # hours of other cells are at stake, whatever went wrong in this one
            failures.append(Failure(cell, _line(error)))
            log.error("%s failed: %s", cell.name, failures[-1].reason)
            if not isinstance(error, Cap4dError):
                log.debug("its traceback", exc_info=True)
        seconds = time.monotonic() - begun
        times += [seconds] if seconds > QUICK else []
        after(results, failures)
    return results, failures


def _left(times: Sequence[float], cells: int) -> str:
    """What the cells so far say of those to come; nothing before the first."""
    if not times:
        return ""
    seconds = int(sum(times) / len(times) * cells)
    return f", about {seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"


def _line(error: Exception) -> str:
    text = " ".join(str(error).split())[:300]
    return text if isinstance(error, Cap4dError) else f"{type(error).__name__}: {text}"
