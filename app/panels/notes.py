"""Messages in a corner of the picture, and the line that says how to go on when nothing was asked for."""

from __future__ import annotations

from cap4d.app.layout import Rect
from cap4d.app.panels.widgets import ImVec2, ImVec4, bare_button, quiet, wrapped
from cap4d.app.theme import BAD, QUIET, TEXT, Icon, icon
from cap4d.app.toasts import Toast, Tone
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

WELCOME = "This is the built-in avatar. Drop a .cap4d file here, or press Ctrl+O; F1 shows the keys."
WIDTH, MARGIN, WELCOME_HEIGHT = 340.0, 14.0, 56.0  # units of design
FLAGS = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.always_auto_resize
)


class Notes:
    """Draws over the picture's lower left corner, the newest message lowest."""

    def draw(self, viewer: Viewer, place: Rect) -> None:
        scale = imgui.get_style().font_scale_dpi
        bottom = place.y + place.height - (MARGIN + WELCOME_HEIGHT * viewer.is_welcome) * scale
        for i, toast in enumerate(reversed(viewer.toasts.current(viewer.now))):
            bottom -= _draw_toast(viewer, toast, i, place.x + MARGIN * scale, bottom) + 6 * scale
        if viewer.is_welcome:
            _draw_welcome(viewer, place)


def _draw_toast(viewer: Viewer, toast: Toast, number: int, left: float, bottom: float) -> float:
    """Returns its height."""
    width = WIDTH * imgui.get_style().font_scale_dpi
    imgui.set_next_window_pos(ImVec2(left, bottom), imgui.Cond_.always, ImVec2(0, 1))
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(width, 400))
    imgui.push_style_var(imgui.StyleVar_.alpha, max(toast.opacity(viewer.now), 0.02))
    imgui.begin(f"note {number}", None, FLAGS)
    imgui.push_text_wrap_pos(width - 24)
    color = BAD if toast.tone is Tone.ERROR else TEXT
    imgui.push_style_color(imgui.Col_.text, ImVec4(*color))
    imgui.text_unformatted(toast.text if toast.count == 1 else f"{toast.text} ({toast.count} times)")
    imgui.pop_style_color()
    imgui.pop_text_wrap_pos()
    if imgui.is_window_hovered() and imgui.is_mouse_clicked(imgui.MouseButton_.left):
        viewer.toasts.dismiss(toast)
    height = imgui.get_window_height()
    imgui.end()
    imgui.pop_style_var()
    return height


def _draw_welcome(viewer: Viewer, place: Rect) -> None:
    scale = imgui.get_style().font_scale_dpi
    at = ImVec2(place.x + place.width / 2, place.y + place.height - MARGIN * scale)
    imgui.set_next_window_pos(at, imgui.Cond_.always, ImVec2(0.5, 1))
    imgui.set_next_window_bg_alpha(0.9)
    if imgui.begin("welcome", None, FLAGS)[0]:
        fits = place.width - 4 * MARGIN * scale - 40
        imgui.push_text_wrap_pos(max(fits, 120))
        imgui.align_text_to_frame_padding()
        quiet(WELCOME) if imgui.calc_text_size(WELCOME).x < fits else wrapped(WELCOME, QUIET)
        imgui.pop_text_wrap_pos()
        imgui.same_line()
        if bare_button(f"{icon(Icon.CLOSE)}##welcome", color=QUIET):
            viewer.is_welcome = False
    imgui.end()
