"""The small window that asks for a file or an address."""

from __future__ import annotations

from pathlib import Path

from cap4d.app.layout import Rect
from cap4d.app.panels.widgets import ImVec2, quiet, tip
from cap4d.app.shortcuts import Action
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

TITLES = {Action.OPEN: "Open a file", Action.DRIVE: "Listen to a live source"}
HINTS = {
    Action.OPEN: "path of a .cap4d, .npz or .npy file",
    Action.DRIVE: "tcp://127.0.0.1:9000",
}
WIDTH = 460.0  # units of design
FLAGS = (
    imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_move
)


class Dialog:
    """Open while `Viewer.dialog` says what it asks for."""

    def __init__(self) -> None:
        self.text = ""
        self._asks: Action | None = None

    def draw(self, viewer: Viewer, place: Rect) -> None:
        asks = viewer.dialog
        if asks is None:
            self._asks = None
            return
        appearing, self._asks = asks is not self._asks, asks
        centre = ImVec2(place.x + place.width / 2, place.y + place.height / 3)
        imgui.set_next_window_pos(centre, imgui.Cond_.always, ImVec2(0.5, 0.5))
        opened, stays = imgui.begin(TITLES[asks], True, FLAGS)
        if opened:
            self._draw_field(viewer, asks, appearing)
            if asks is Action.OPEN:
                _draw_recent(viewer)
        imgui.end()
        if not stays:
            viewer.dialog = None

    def _draw_field(self, viewer: Viewer, asks: Action, appearing: bool) -> None:
        if appearing:
            self.text = ""
            imgui.set_keyboard_focus_here()
        imgui.set_next_item_width(WIDTH * imgui.get_style().font_scale_dpi)
        entered, self.text = imgui.input_text_with_hint(
            "##text", HINTS[asks], self.text, imgui.InputTextFlags_.enter_returns_true
        )
        text = self.text.strip()
        imgui.begin_disabled(not text)
        entered |= imgui.button("Open" if asks is Action.OPEN else "Listen")
        imgui.end_disabled()
        if entered and text:
            viewer.dialog = None
            if asks is Action.OPEN:
                viewer.open(Path(text).expanduser())
            else:
                viewer.drive(text)


def _draw_recent(viewer: Viewer) -> None:
    if viewer.recent.files:
        imgui.spacing()
        quiet("Lately")
    for i, file in enumerate(viewer.recent.files):
        if imgui.selectable(f"{file.name}##{i}", False)[0]:
            viewer.dialog = None
            viewer.open(file)
        tip(str(file))
