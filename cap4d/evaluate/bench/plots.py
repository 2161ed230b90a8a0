"""Which pictures a report has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cap4d.evaluate.bench.figure import new_figure
from cap4d.evaluate.bench.plot_avatars import draw_deformers, draw_frames, draw_pareto
from cap4d.evaluate.bench.plot_splatting import draw_peers, draw_roofline, draw_scaling

Report = dict[str, Any]
PLOTS: dict[str, Callable[[Any, Report], None]] = {
    "splat_scaling": draw_scaling,
    "splat_roofline": draw_roofline,
    "deformer": draw_deformers,
    "frame_times": draw_frames,
    "frame_pareto": draw_pareto,
    "peers": draw_peers,
}
"""By file name, which begins with the name of the section that has the numbers."""


def draw_plots(folder: Path, report: Report) -> list[str]:
    """Draws what the report has numbers for and returns the file names.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    drawn = []
    for name, draw in PLOTS.items():
        if report.get(name.split("_")[0]):
            with new_figure(folder / f"{name}.png") as figure:
                draw(figure, report)
            drawn.append(f"{name}.png")
    return drawn
