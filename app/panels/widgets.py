"""What several panels are made of: bars to drag, buttons with symbols, pairs of words."""

from __future__ import annotations

from functools import cache

from cap4d.app.theme import ACCENT, FIELD, FIELD_HOVERED, HELD, QUIET, TEXT, Color
from imgui_bundle import imgui

ImVec2, ImVec4 = imgui.ImVec2, imgui.ImVec4
FIXED = (
    imgui.WindowFlags_.no_title_bar
    | imgui.WindowFlags_.no_resize
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_collapse
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_bring_to_front_on_focus
    | imgui.WindowFlags_.no_nav
)
"""A window that is part of the layout."""
SLIDER = imgui.SliderFlags_.always_clamp | imgui.SliderFlags_.no_round_to_format
HIDDEN_GRAB = (imgui.Col_.slider_grab, imgui.Col_.slider_grab_active)


def units(design: float) -> float:
    """Window units of so many units of design."""
    return design * imgui.get_style().font_scale_dpi


@cache
def color32(color: Color, opacity: float = 1.0) -> int:
    """A colour as draw lists take it."""
    red, green, blue, alpha = (round(255 * min(max(c, 0.0), 1.0)) for c in (*color[:3], color[3] * opacity))
    return alpha << 24 | blue << 16 | green << 8 | red


def bar(
    key: str,
    text: str,
    value: float,
    low: float,
    high: float,
    *,
    held: bool,
    width: float,
    number: str = "%.2f",
) -> float | None:
    """A bar as wide as the value is large, with its name and number on it, to drag or type on (ctrl-click).

    Args:
        key: Unique in its window.
        held: Drawn as what the user's hand holds.
        width: Window units.
    Returns:
        The new value, or None where the user did nothing.
    """
    size = ImVec2(width, imgui.get_frame_height())
    if not imgui.is_rect_visible(size):  # scrolled away: most bars of a long list are
        imgui.dummy(size)
        return None
    typing = imgui.internal.temp_input_is_active(imgui.get_id(f"##{key}"))
    hidden = HIDDEN_GRAB if typing else (*HIDDEN_GRAB, imgui.Col_.text)
    for part in hidden:
        imgui.push_style_color(part, 0)
    imgui.set_next_item_width(width)
    changed, wanted = imgui.slider_float(f"##{key}", value, low, high, "%.3f", SLIDER)
    imgui.pop_style_color(len(hidden))
    if not typing:
        _paint_bar(text, wanted if changed else value, low, high, held, number)
    return wanted if changed else None


def _paint_bar(text: str, value: float, low: float, high: float, held: bool, number: str) -> None:
    least, most = imgui.get_item_rect_min(), imgui.get_item_rect_max()
    draw, span = imgui.get_window_draw_list(), most.x - least.x
    zero, at = ((min(max(v, low), high) - low) / (high - low) for v in (0.0, value))
    left, right = least.x + span * min(zero, at), least.x + span * max(zero, at)
    color = HELD if held else ACCENT
    if right - left > 0.5:
        strength = 0.42 if imgui.is_item_active() else 0.34 if imgui.is_item_hovered() else 0.26
        rounding = imgui.get_style().frame_rounding
        draw.add_rect_filled(ImVec2(left, least.y), ImVec2(right, most.y), color32(color, strength), rounding)
    pad = imgui.get_style().frame_padding
    y, right = least.y + pad.y, most.x - pad.x
    shown = signless_zero(number % value)
    room = right - imgui.calc_text_size(shown).x
    # Clipped on the CPU: a clip rectangle would make each bar a draw call of its own.
    clip, font = imgui.ImVec4(least.x, least.y, room - pad.x, most.y), imgui.get_font()
    at, name = ImVec2(least.x + pad.x, y), color32(HELD if held else TEXT)
    draw.add_text(font, imgui.get_font_size(), at, name, text, 0.0, clip)
    draw.add_text(ImVec2(room, y), color32(HELD if held else QUIET), shown)


def quiet(text: str) -> None:
    """Text of less weight."""
    imgui.push_style_color(imgui.Col_.text, ImVec4(*QUIET))
    imgui.text_unformatted(text)
    imgui.pop_style_color()


def wrapped(text: str, color: Color = TEXT) -> None:
    """Text in lines as wide as the panel."""
    imgui.push_style_color(imgui.Col_.text, ImVec4(*color))
    imgui.push_text_wrap_pos(0.0)
    imgui.text_unformatted(text)
    imgui.pop_text_wrap_pos()
    imgui.pop_style_color()


def tip(text: str) -> None:
    """Says `text` while the pointer rests on the last item."""
    if imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip) and imgui.begin_tooltip():
        imgui.text_unformatted(text)
        imgui.end_tooltip()


def bare_button(label: str, *, size: tuple[float, float] = (0, 0), color: Color | None = None) -> bool:
    """A button without a field behind it."""
    imgui.push_style_color(imgui.Col_.button, 0)
    if color is not None:
        imgui.push_style_color(imgui.Col_.text, ImVec4(*color))
    pressed = imgui.button(label, ImVec2(*size))
    imgui.pop_style_color(1 if color is None else 2)
    return pressed


def lit_button(label: str, lit: bool, *, size: tuple[float, float] = (0, 0)) -> bool:
    """A button that is bright while what it stands for is on."""
    return bare_button(label, size=size, color=ACCENT if lit else QUIET)


def choice(label: str, chosen: bool, note: str = "") -> bool:
    """A line to pick, with a note at its right end."""
    imgui.push_style_color(imgui.Col_.header, ImVec4(*FIELD))
    imgui.push_style_color(imgui.Col_.header_hovered, ImVec4(*FIELD_HOVERED))
    picked, _ = imgui.selectable(f"##{label}", chosen, imgui.SelectableFlags_.allow_overlap)
    imgui.pop_style_color(2)
    least, most = imgui.get_item_rect_min(), imgui.get_item_rect_max()
    draw, pad = imgui.get_window_draw_list(), imgui.get_style().frame_padding.x
    height = imgui.get_text_line_height()
    y = (least.y + most.y - height) / 2
    if chosen:
        draw.add_circle_filled(ImVec2(least.x + pad + units(3), y + height / 2), units(3), color32(ACCENT))
    draw.add_text(ImVec2(least.x + pad + units(14), y), color32(TEXT if chosen else QUIET), label)
    size = imgui.calc_text_size(note)
    draw.add_text(ImVec2(most.x - pad - size.x, y), color32(QUIET), note)
    return picked


def signless_zero(text: str) -> str:
    """`-0.00` -> `0.00`"""
    return text if any(digit in text for digit in "123456789") else text.removeprefix("-")


def shortened(text: str, most: int = 26) -> str:
    """`a long file name` -> `a long...ile name`"""
    if len(text) <= most:
        return text
    return f"{text[: most // 2 - 2]}...{text[-(most // 2 - 1) :]}"


def section(title: str, *, opened: bool = True) -> bool:
    """A heading that folds what is under it."""
    flags = imgui.TreeNodeFlags_.default_open if opened else 0
    return imgui.collapsing_header(title, flags)


def pairs(key: str, rows: list[tuple[str, str]]) -> None:
    """A table of names and values."""
    if rows and imgui.begin_table(key, 2):
        imgui.table_setup_column("name", imgui.TableColumnFlags_.width_stretch)
        imgui.table_setup_column("value", imgui.TableColumnFlags_.width_fixed)
        for name, value in rows:
            imgui.table_next_row()
            imgui.table_next_column()
            quiet(name)
            imgui.table_next_column()
            shown = shortened(value)
            room = imgui.get_content_region_avail().x - imgui.calc_text_size(shown).x
            imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + max(room, 0))
            imgui.text_unformatted(shown)
        imgui.end_table()
