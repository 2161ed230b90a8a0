"""How the panels look: type, icons, colours and spacing."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import glfw  # noqa: F401  before imgui_bundle, which otherwise loads its own, X11-only GLFW
import imgui_bundle
from imgui_bundle import imgui

FONT_SIZE = 15.0  # window units, before the display's own scale
FONTS = Path(imgui_bundle.__file__).parent / "assets" / "fonts"
TEXT_FONT, ICON_FONT = FONTS / "Roboto" / "Roboto-Regular.ttf", FONTS / "Font_Awesome_6_Free-Solid-900.otf"

Color = tuple[float, float, float, float]

TEXT: Color = (0.90, 0.91, 0.93, 1.0)
QUIET: Color = (0.56, 0.59, 0.64, 1.0)
ACCENT: Color = (0.42, 0.66, 0.98, 1.0)
HELD: Color = (0.98, 0.74, 0.38, 1.0)  # what the user's hand holds
GOOD: Color = (0.46, 0.80, 0.56, 1.0)
BAD: Color = (0.96, 0.48, 0.46, 1.0)
PANEL: Color = (0.115, 0.122, 0.137, 1.0)
BAR: Color = (0.095, 0.100, 0.113, 1.0)
FIELD: Color = (0.175, 0.186, 0.208, 1.0)
FIELD_HOVERED: Color = (0.215, 0.228, 0.255, 1.0)
FIELD_ACTIVE: Color = (0.245, 0.262, 0.295, 1.0)
LINE: Color = (1.0, 1.0, 1.0, 0.07)
CLEAR: Color = (0.0, 0.0, 0.0, 0.0)


class Icon:
    """Symbols of Font Awesome 6; plain text where its font is missing."""

    PLAY, PAUSE, STOP = "\uf04b", "\uf04c", "\uf04d"
    BACK, FORWARD, REPEAT = "\uf048", "\uf051", "\uf363"
    PHOTO, RECORD = "\uf030", "\uf111"
    RANDOM, RESET, NEUTRAL = "\uf522", "\uf2ea", "\uf118"
    CLOSE, LIVE = "\uf00d", "\uf519"


PLAIN = {
    Icon.PLAY: "Play", Icon.PAUSE: "Pause", Icon.STOP: "Stop", Icon.BACK: "<", Icon.FORWARD: ">",
    Icon.REPEAT: "Loop", Icon.PHOTO: "Photo", Icon.RECORD: "Rec", Icon.RANDOM: "Random", Icon.RESET: "Reset",
    Icon.NEUTRAL: "Neutral", Icon.CLOSE: "x", Icon.LIVE: "Live",
}  # fmt: skip


@cache
def icon(symbol: str) -> str:
    """The symbol, or its word where there is no font for it."""
    return symbol if ICON_FONT.is_file() else PLAIN[symbol]


def load_fonts(io: imgui.IO) -> None:
    """Roboto with the icons in it; Dear ImGui's own font where the files are missing."""
    if not TEXT_FONT.is_file():
        io.fonts.add_font_default()
        return
    io.fonts.add_font_from_file_ttf(str(TEXT_FONT), FONT_SIZE)
    if ICON_FONT.is_file():
        config = imgui.ImFontConfig()
        config.merge_mode = True
        config.glyph_min_advance_x = FONT_SIZE
        config.glyph_offset = imgui.ImVec2(0, 1)
        io.fonts.add_font_from_file_ttf(str(ICON_FONT), FONT_SIZE * 0.8, config)


def apply_theme(style: imgui.Style, scale: float) -> None:
    """A calm dark theme.

    Args:
        style: Of a context that has none yet: sizes are set, then multiplied by `scale`.
        scale: Window units per unit of design.
    """
    _space(style)
    _paint(style)
    style.scale_all_sizes(scale)
    style.font_scale_dpi = scale


def _space(style: imgui.Style) -> None:
    vectors = {
        "window_padding": (14, 12),
        "frame_padding": (8, 4.5),
        "cell_padding": (4, 3),
        "item_spacing": (8, 7),
        "item_inner_spacing": (6, 5),
        "window_title_align": (0.5, 0.5),
        "separator_text_padding": (0, 6),
    }
    numbers = {
        "window_rounding": 8, "child_rounding": 6, "frame_rounding": 5, "popup_rounding": 6,
        "grab_rounding": 5,
        "scrollbar_rounding": 6, "tab_rounding": 5, "scrollbar_size": 11, "grab_min_size": 10,
        "indent_spacing": 12, "window_border_size": 0, "popup_border_size": 1, "frame_border_size": 0,
        "child_border_size": 0, "separator_text_border_size": 1, "tab_bar_border_size": 1,
    }  # fmt: skip
    for name, value in vectors.items():
        setattr(style, name, imgui.ImVec2(*value))
    for name, number in numbers.items():
        setattr(style, name, number)


def _paint(style: imgui.Style) -> None:
    imgui.style_colors_dark(style)
    colors = {
        "text": TEXT, "text_disabled": QUIET, "window_bg": PANEL, "child_bg": CLEAR, "menu_bar_bg": BAR,
        "popup_bg": (0.135, 0.143, 0.160, 0.99), "border": (1, 1, 1, 0.09), "frame_bg": FIELD,
        "frame_bg_hovered": FIELD_HOVERED, "frame_bg_active": FIELD_ACTIVE, "title_bg": BAR,
        "title_bg_active": BAR, "title_bg_collapsed": BAR, "button": FIELD, "button_hovered": FIELD_HOVERED,
        "button_active": FIELD_ACTIVE, "header": (1, 1, 1, 0.035), "header_hovered": (1, 1, 1, 0.075),
        "header_active": (1, 1, 1, 0.10), "slider_grab": (0.62, 0.66, 0.72, 1),
        "slider_grab_active": (0.85, 0.88, 0.92, 1), "check_mark": ACCENT, "separator": LINE,
        "scrollbar_bg": CLEAR, "scrollbar_grab": (1, 1, 1, 0.12), "scrollbar_grab_hovered": (1, 1, 1, 0.2),
        "scrollbar_grab_active": (1, 1, 1, 0.28), "tab": CLEAR, "tab_hovered": FIELD_HOVERED,
        "tab_selected": FIELD, "tab_selected_overline": ACCENT, "plot_lines": ACCENT,
        "plot_histogram": ACCENT, "text_selected_bg": (0.42, 0.66, 0.98, 0.35),
        "modal_window_dim_bg": (0, 0, 0, 0.45), "resize_grip": CLEAR, "nav_cursor": ACCENT,
    }  # fmt: skip
    for name, color in colors.items():
        style.set_color_(getattr(imgui.Col_, name), imgui.ImVec4(*color))
