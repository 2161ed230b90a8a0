"""Legends of overlays as Dear ImGui draws them: colour bars in the picture's lower right corner."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from cap4d.app.layout import Rect
from cap4d.app.overlays.legend import Legend
from cap4d.app.panels.widgets import units
from imgui_bundle import imgui

BAR = 260.0, 12.0  # units of design
MARGIN = 14.0
PANEL = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_inputs
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.no_focus_on_appearing
)


def draw_legends(legends: Sequence[Legend], place: Rect) -> None:
    """Adds a panel to the frame of Dear ImGui that is being made; none where there are no legends."""
    if not legends:
        return
    corner = imgui.ImVec2(place.x + place.width - units(MARGIN), place.y + place.height - units(MARGIN))
    imgui.set_next_window_pos(corner, pivot=imgui.ImVec2(1, 1))
    imgui.set_next_window_bg_alpha(0.8)
    imgui.begin("legends", None, PANEL)
    for legend in legends:
        imgui.text_unformatted(legend.title)
        _bar(legend)
    imgui.end()


def _bar(legend: Legend) -> None:
    """The colours and the numbers below them."""
    draw, corner = imgui.get_window_draw_list(), imgui.get_cursor_screen_pos()
    length, height = units(BAR[0]), units(BAR[1])
    packed = [imgui.get_color_u32(imgui.ImVec4(*(c / 255 for c in color), 1)) for color in legend.colors]
    width = length / (len(packed) - 1)
    for k, (left, right) in enumerate(pairwise(packed)):
        low = imgui.ImVec2(corner.x + k * width, corner.y)
        high = imgui.ImVec2(corner.x + (k + 1) * width, corner.y + height)
        draw.add_rect_filled_multi_color(low, high, left, right, right, left)
    ink = imgui.get_color_u32(imgui.Col_.text)
    for share, text in legend.ticks:
        room = length - imgui.calc_text_size(text).x
        at = imgui.ImVec2(corner.x + share * room, corner.y + height + 2)
        draw.add_text(at, ink, text)
    imgui.dummy(imgui.ImVec2(length, height + imgui.get_text_line_height() + 4))
