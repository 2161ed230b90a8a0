"""Markdown tables of numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a table, a blank one last. The first column is text, the others are numbers."""
    cells = [[cell(value) for value in row] for row in rows]
    return [_line(head), _line(["---", *["---:"] * (len(head) - 1)]), *map(_line, cells), ""]


def cell(value: object) -> str:
    """Three significant digits of a small number, one decimal of a large one, a dash for what is not
    there.
    """
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _line(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"
