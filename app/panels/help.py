"""The keys, over everything else."""

from __future__ import annotations

from cap4d.app.layout import Rect
from cap4d.app.panels.widgets import ImVec2, quiet
from cap4d.app.shortcuts import POINTER, SHORTCUTS
from cap4d.app.theme import ACCENT
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

FLAGS = (
    imgui.WindowFlags_.no_resize
    | imgui.WindowFlags_.no_collapse
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_saved_settings
)


class HelpPanel:
    """Two columns."""

    def draw(self, viewer: Viewer, place: Rect) -> None:
        if not viewer.shows_help:
            return
        centre = ImVec2(place.x + place.width / 2, place.y + place.height / 2)
        imgui.set_next_window_pos(centre, imgui.Cond_.always, ImVec2(0.5, 0.5))
        opened, viewer.shows_help = imgui.begin("Keys and mouse", True, FLAGS)
        if opened:
            groups = [(title, [(s.shown, s.text) for s in keys]) for title, keys in SHORTCUTS.items()]
            _draw_column([groups[0], groups[3]])
            imgui.same_line(0, 28)
            _draw_column([groups[1], groups[2], ("Pointer", list(POINTER))])
        imgui.end()


def _draw_column(groups: list[tuple[str, list[tuple[str, str]]]]) -> None:
    """Lines of a key and what it does, in groups; the texts start below each other."""
    indent = max(imgui.calc_text_size(key).x for _, rows in groups for key, _ in rows) + 14
    imgui.begin_group()
    for title, rows in groups:
        imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*ACCENT))
        imgui.text_unformatted(title)
        imgui.pop_style_color()
        for key, text in rows:
            left = imgui.get_cursor_pos_x()
            imgui.text_unformatted(key)
            imgui.same_line()
            imgui.set_cursor_pos_x(left + indent)
            quiet(text)
        imgui.spacing()
    imgui.end_group()
