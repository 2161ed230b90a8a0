"""The menu bar; at its right end how fast it goes and how exact it is."""

from __future__ import annotations

from cap4d.app.layout import MENU
from cap4d.app.panels.look import error_text
from cap4d.app.panels.widgets import ImVec2, quiet, units
from cap4d.app.shortcuts import Action, shown_key
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui


class Menu:
    """File, View, Help."""

    def draw(self, viewer: Viewer) -> None:
        imgui.push_style_var(
            imgui.StyleVar_.frame_padding,
            ImVec2(units(8), units(MENU) / 2 - imgui.get_text_line_height() / 2),
        )
        if imgui.begin_main_menu_bar():
            if imgui.begin_menu("File"):
                _draw_file(viewer)
                imgui.end_menu()
            if imgui.begin_menu("View"):
                _draw_view(viewer)
                imgui.end_menu()
            if imgui.begin_menu("Help"):
                _item(viewer, Action.HELP, "Keys and mouse")
                imgui.end_menu()
            _draw_read_out(read_out(viewer))
            imgui.end_main_menu_bar()
        imgui.pop_style_var()


def read_out(viewer: Viewer) -> str:
    """`30 fps   int8, 0.003 mm`; or what takes a moment."""
    if viewer.jobs.label is not None:
        return f"{viewer.jobs.label} ..."
    loaded, tier = viewer.loaded, viewer.avatar.tier
    error = "exact" if tier == loaded.tiers[0] else error_text(loaded.bundle.tier_errors.get(tier))
    return f"{viewer.timings.fps():.0f} fps   {tier}, {error}"


def _item(viewer: Viewer, action: Action, text: str, *, on: bool = False) -> None:
    if imgui.menu_item_simple(text, shown_key(action), on):
        viewer.act(action)


def _draw_file(viewer: Viewer) -> None:
    _item(viewer, Action.OPEN, "Open ...")
    if imgui.begin_menu("Open recent", bool(viewer.recent.files)):
        for i, file in enumerate(viewer.recent.files):
            if imgui.menu_item_simple(f"{file.name}##{i}"):
                viewer.open(file)
        imgui.separator()
        if imgui.menu_item_simple("Forget these"):
            viewer.recent.clear()
        imgui.end_menu()
    imgui.separator()
    _item(viewer, Action.DRIVE, "Listen to a live source ...")
    _item(viewer, Action.IDLE, "Play the avatar's idle clip")
    imgui.separator()
    _item(viewer, Action.SCREENSHOT, "Screenshot")
    _item(viewer, Action.RECORD, "Record", on=viewer.recording_since is not None)
    imgui.separator()
    _item(viewer, Action.QUIT, "Quit")


def _draw_view(viewer: Viewer) -> None:
    _item(viewer, Action.SIDEBAR, "Sidebar", on=viewer.shows_sidebar)
    _item(viewer, Action.PANELS, "Panels", on=viewer.shows_panels)
    _item(viewer, Action.FULLSCREEN, "Full screen")
    _item(viewer, Action.VSYNC, "Vsync", on=viewer.has_vsync)
    imgui.separator()
    _item(viewer, Action.RESET_VIEW, "Reset the camera")
    _item(viewer, Action.RESET_FACE, "Let go of every slider")


def _draw_read_out(text: str) -> None:
    width = imgui.calc_text_size(text).x + 2 * imgui.get_style().window_padding.x
    imgui.set_cursor_pos_x(max(imgui.get_window_width() - width, imgui.get_cursor_pos_x()))
    quiet(text)
