"""How fast it goes: pictures per second, the time of each stage as a graph, and what a live source counts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from cap4d.app.panels.widgets import ImVec2, color32, pairs, quiet, section, units
from cap4d.app.theme import FIELD, PANEL, QUIET, Color
from cap4d.app.timings import HISTORY, STAGES
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

COLORS: dict[str, Color] = {
    "rig": (0.42, 0.66, 0.98, 1),
    "deform": (0.66, 0.56, 0.96, 1),
    "bind": (0.40, 0.80, 0.78, 1),
    "sort": (0.55, 0.82, 0.50, 1),
    "splat": (0.97, 0.74, 0.38, 1),
    "gui": (0.60, 0.62, 0.66, 1),
}
GRAPH_HEIGHT = 76.0  # units of design
STEPS_MS = (4.0, 8.0, 16.0, 33.0, 67.0, 133.0, 267.0, 533.0, 1067.0)  # heights that the graph may have


class TimingPanel:
    """Numbers change twice a second, the graph with every picture."""

    title = "Stats"

    def draw(self, viewer: Viewer) -> None:
        if section("Frame time"):
            timings = viewer.timings
            _draw_graph(timings.rows())
            numbers = timings.milliseconds()
            _draw_legend(numbers)
            pairs(
                "rate",
                [("pictures a second", f"{timings.fps():.1f}"), ("skipped", f"{viewer.playback.dropped:,}")],
            )
        if viewer.playback.is_live and section("Live source"):
            pairs("live", statistics_rows(viewer.playback.statistics()))
        if section("Avatar"):
            bundle = viewer.loaded.bundle
            rows = [
                ("file", viewer.loaded.path.name),
                ("rig", bundle.rig_name),
                ("Gaussians", f"{len(bundle):,}"),
                ("triangles", f"{len(bundle.grid.faces):,}"),
                ("expressions", f"{bundle.n_expressions}"),
            ]
            pairs("avatar", rows)


def statistics_rows(statistics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """A source's counts as names and values; what holds further counts is unfolded, zeros in it left out."""
    rows = []
    for name, value in statistics.items():
        if isinstance(value, Mapping):
            rows += [(_label(name, inner), _shown(v)) for inner, v in value.items() if v]
        else:
            rows.append((_label(name), _shown(value)))
    return rows


def graph_top(rows: np.ndarray) -> float:
    """ms: a step that nearly all pictures stay under: one slow picture does not flatten the rest."""
    most = float(np.percentile(rows.sum(1), 95)) if len(rows) else 0.0
    return next((step for step in STEPS_MS if most <= step), STEPS_MS[-1])


def _label(name: str, inner: str = "") -> str:
    """`latency_ms`, `median` -> `latency, median ms`"""
    unit = "ms" if name.endswith("_ms") else ""
    detail = " ".join(filter(None, (inner, unit)))
    return ", ".join(filter(None, (name.removesuffix("_ms"), detail))).replace("_", " ")


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.1f}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _draw_graph(rows: np.ndarray) -> None:
    size = ImVec2(imgui.get_content_region_avail().x, units(GRAPH_HEIGHT))
    at = imgui.get_cursor_screen_pos()
    imgui.dummy(size)
    draw, top = imgui.get_window_draw_list(), graph_top(rows)
    end = ImVec2(at.x + size.x, at.y + size.y)
    draw.add_rect_filled(at, end, color32(FIELD), 4)
    draw.push_clip_rect(at, end, True)
    width, bottom = size.x / HISTORY, end.y
    heights = np.cumsum(rows, 1) * (size.y / top)
    left = end.x - len(rows) * width
    for i, picture in enumerate(heights.tolist()):
        x, below = left + i * width, 0.0
        for name, above in zip(STAGES, picture, strict=True):
            if above - below > 0.4:
                draw.add_rect_filled(
                    ImVec2(x, bottom - above), ImVec2(x + width, bottom - below), PACKED[name]
                )
                below = above
    draw.pop_clip_rect()
    _draw_label(ImVec2(at.x + 6, at.y + 5), f"{top:.0f} ms")


def _draw_label(at: ImVec2, text: str) -> None:
    draw, size = imgui.get_window_draw_list(), imgui.calc_text_size(text)
    draw.add_rect_filled(ImVec2(at.x - 4, at.y - 2), ImVec2(at.x + size.x + 4, at.y + size.y + 2), LABEL, 4)
    draw.add_text(at, color32(QUIET), text)


def _draw_legend(numbers: Mapping[str, float]) -> None:
    if not numbers:
        quiet("no picture yet")
    if numbers and imgui.begin_table("legend", 2):
        for name, milliseconds in numbers.items():
            imgui.table_next_column()
            at, line = imgui.get_cursor_screen_pos(), imgui.get_text_line_height()
            centre = ImVec2(at.x + units(4), at.y + line / 2)
            imgui.get_window_draw_list().add_circle_filled(centre, units(4), PACKED[name])
            imgui.dummy(ImVec2(units(8), line))
            imgui.same_line()
            quiet(name)
            imgui.same_line()
            imgui.text_unformatted(f"{milliseconds:.1f} ms")
        imgui.end_table()


LABEL = color32(PANEL, 0.75)
PACKED = {name: color32(color) for name, color in COLORS.items()}
