"""What the report's pictures have in common: colours, axes, ticks. matplotlib is imported when it is used."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.atomic import replacing

INK, FAINT, GRID = "#222222", "#8a8a8a", "#e6e6e6"
BLUE, RED, GREEN, AMBER, VIOLET = "#0f6cbd", "#c8374f", "#2a9d8f", "#d98c1f", "#6d4c9f"
PASSES = {"forward": ("forward", BLUE), "forward_backward": ("forward + backward", RED)}
DPI = 130


@contextmanager
def new_figure(path: Path) -> Iterator[Any]:
    """A figure that becomes the file when the body ends well."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    yield figure
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def add_axes(figure: Any, where: Any, title: str, x: str, y: str) -> Any:
    axes = figure.add_subplot(*where) if isinstance(where, tuple) else figure.add_subplot(where)
    axes.set_title(title, fontsize=11, color=INK, loc="left")
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def add_title(figure: Any, text: str) -> None:
    figure.suptitle(text, fontsize=13, x=0.01, ha="left", color=INK)


def plain_ticks(axis: Any, ticks: Sequence[float]) -> None:
    """Numbers instead of powers of ten on a logarithmic axis."""
    from matplotlib.ticker import NullFormatter, NullLocator

    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])


def nice_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5, 10, ... around a range."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    ticks = [m * 10.0**p for p in powers for m in (1, 2, 5)]
    return [t for t in ticks if low / 1.5 <= t <= high * 1.5]
