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
    """Two columns of keys and one of what the pointer does."""

    def draw(self, viewer: Viewer, place: Rect) -> None:
        if not viewer.shows_help:
            return
        centre = ImVec2(place.x + place.width / 2, place.y + place.height / 2)
        imgui.set_next_window_pos(centre, imgui.Cond_.always, ImVec2(0.5, 0.5))
        opened, viewer.shows_help = imgui.begin("Keys and mouse", True, FLAGS)
        if opened and imgui.begin_table("columns", 2, imgui.TableFlags_.pad_outer_x):
            groups = [(title, [(s.shown, s.text) for s in keys]) for title, keys in SHORTCUTS.items()]
            imgui.table_next_column()
            _draw_groups([groups[0], groups[3]])
            imgui.table_next_column()
            _draw_groups([groups[1], groups[2], ("Pointer", list(POINTER))])
            imgui.end_table()
        imgui.end()


def _draw_groups(groups: list[tuple[str, list[tuple[str, str]]]]) -> None:
    for title, rows in groups:
        imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*ACCENT))
        imgui.text_unformatted(title)
        imgui.pop_style_color()
        if imgui.begin_table(title, 2, imgui.TableFlags_.sizing_fixed_fit):
            for key, text in rows:
                imgui.table_next_column()
                imgui.text_unformatted(key)
                imgui.table_next_column()
                quiet(text)
            imgui.end_table()
        imgui.spacing()
