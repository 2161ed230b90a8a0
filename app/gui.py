"""Dear ImGui in a window: its context, what the window's input means to it, and its picture on top."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import glfw
import moderngl
from cap4d.app.gui_draw import GuiDraw
from cap4d.app.theme import apply_theme, load_fonts
from imgui_bundle import imgui

SETTLE = 3  # pictures after an input: Dear ImGui takes a click apart into one for down and one for up
LONGEST_STEP = 0.25  # s that one picture may make its animations go on

KEYS = {
    glfw.KEY_TAB: imgui.Key.tab,
    glfw.KEY_LEFT: imgui.Key.left_arrow,
    glfw.KEY_RIGHT: imgui.Key.right_arrow,
    glfw.KEY_UP: imgui.Key.up_arrow,
    glfw.KEY_DOWN: imgui.Key.down_arrow,
    glfw.KEY_PAGE_UP: imgui.Key.page_up,
    glfw.KEY_PAGE_DOWN: imgui.Key.page_down,
    glfw.KEY_HOME: imgui.Key.home,
    glfw.KEY_END: imgui.Key.end,
    glfw.KEY_INSERT: imgui.Key.insert,
    glfw.KEY_DELETE: imgui.Key.delete,
    glfw.KEY_BACKSPACE: imgui.Key.backspace,
    glfw.KEY_SPACE: imgui.Key.space,
    glfw.KEY_ENTER: imgui.Key.enter,
    glfw.KEY_KP_ENTER: imgui.Key.keypad_enter,
    glfw.KEY_ESCAPE: imgui.Key.escape,
    glfw.KEY_A: imgui.Key.a,
    glfw.KEY_C: imgui.Key.c,
    glfw.KEY_V: imgui.Key.v,
    glfw.KEY_X: imgui.Key.x,
    glfw.KEY_Y: imgui.Key.y,
    glfw.KEY_Z: imgui.Key.z,
}
"""What text fields know beside characters."""
MODIFIERS = {
    glfw.MOD_CONTROL: imgui.Key.mod_ctrl,
    glfw.MOD_SHIFT: imgui.Key.mod_shift,
    glfw.MOD_ALT: imgui.Key.mod_alt,
    glfw.MOD_SUPER: imgui.Key.mod_super,
}
CURSORS = {
    imgui.MouseCursor_.text_input: glfw.IBEAM_CURSOR,
    imgui.MouseCursor_.hand: glfw.HAND_CURSOR,
    imgui.MouseCursor_.resize_ew: glfw.HRESIZE_CURSOR,
    imgui.MouseCursor_.resize_ns: glfw.VRESIZE_CURSOR,
}


class Clipboard(Protocol):
    """The system's clipboard, as text."""

    def copied(self) -> str: ...

    def copy(self, text: str) -> None: ...


class Gui:
    """Owns a Dear ImGui context: call `release` before GL goes.

    Args:
        ctx: OpenGL 4.1 or newer.
        scale: Window units per unit of design: above 1 where a display has more pixels to the inch and does
            not say so by itself.
        clipboard: None: what is copied stays in the window.
    """

    def __init__(
        self, ctx: moderngl.Context, *, scale: float = 1.0, clipboard: Clipboard | None = None
    ) -> None:
        self.imgui = imgui.create_context()
        imgui.set_current_context(self.imgui)
        io = imgui.get_io()
        io.set_ini_filename("")
        io.backend_flags |= imgui.BackendFlags_.renderer_has_textures | imgui.BackendFlags_.has_mouse_cursors
        io.config_error_recovery_enable_assert = False  # a panel that raises leaves windows open
        io.config_windows_move_from_title_bar_only = True
        load_fonts(io)
        apply_theme(imgui.get_style(), scale)
        self.scale = scale
        self.draw = GuiDraw(ctx)
        self.unsettled = SETTLE  # pictures until it stands still
        if clipboard is not None:
            platform = imgui.get_platform_io()
            platform.platform_get_clipboard_text_fn = lambda _: clipboard.copied()
            platform.platform_set_clipboard_text_fn = lambda _, text: clipboard.copy(text)

    @property
    def wants_pointer(self) -> bool:
        """The pointer is over a panel, or drags something of one."""
        return self._io().want_capture_mouse

    @property
    def wants_keys(self) -> bool:
        """Keys go into a text field."""
        io = self._io()
        return io.want_text_input or io.want_capture_keyboard

    @property
    def is_moving(self) -> bool:
        """Whether the next picture would be another one though nothing happens."""
        return self.unsettled > 0

    def touch(self) -> None:
        """Something changed that the panels show."""
        self.unsettled = max(self.unsettled, SETTLE)

    def pointer(self, x: float, y: float) -> None:
        """The pointer is at (x, y), window units, y down."""
        self._io().add_mouse_pos_event(x, y)
        self.touch()

    def button(self, button: int, down: bool) -> None:
        """A mouse button of glfw's numbers; further ones than Dear ImGui knows are ignored."""
        if 0 <= button < 5:
            self._io().add_mouse_button_event(button, down)
        self.touch()

    def wheel(self, dx: float, dy: float) -> None:
        self._io().add_mouse_wheel_event(dx, dy)
        self.touch()

    def key(self, key: int, down: bool, modifiers: int) -> None:
        """A key of glfw's numbers."""
        io = self._io()
        for mask, name in MODIFIERS.items():
            io.add_key_event(name, bool(modifiers & mask))
        if key in KEYS:
            io.add_key_event(KEYS[key], down)
        self.touch()

    def text(self, codepoint: int) -> None:
        """A character was typed."""
        self._io().add_input_character(codepoint)
        self.touch()

    def focus(self, focused: bool) -> None:
        """The window got or lost the keyboard."""
        self._io().add_focus_event(focused)
        self.touch()

    @contextmanager
    def frame(self, size: tuple[int, int], pixels: tuple[int, int], seconds: float) -> Iterator[None]:
        """The body makes the panels; at its end they are drawn into the framebuffer in use.

        Args:
            size: The window, window units.
            pixels: The framebuffer.
            seconds: Since the last picture.
        """
        self.begin(size, pixels, seconds)
        try:
            yield
        finally:
            self.end()
        self.draw.draw(imgui.get_draw_data())

    def begin(self, size: tuple[int, int], pixels: tuple[int, int], seconds: float) -> None:
        """See `frame`."""
        io = self._io()
        width, height = max(size[0], 1), max(size[1], 1)
        io.display_size = imgui.ImVec2(width, height)
        io.display_framebuffer_scale = imgui.ImVec2(pixels[0] / width, pixels[1] / height)
        io.delta_time = min(max(seconds, 1e-4), LONGEST_STEP)
        imgui.new_frame()

    def end(self) -> None:
        """Makes the geometry of the panels."""
        imgui.render()
        self.unsettled = max(self.unsettled - 1, 0)

    def cursor(self) -> int | None:
        """The shape that the pointer should have: one of glfw's; None is the arrow."""
        imgui.set_current_context(self.imgui)
        return CURSORS.get(imgui.get_mouse_cursor())

    def release(self) -> None:
        """Ends the Dear ImGui context; its textures go with the GL context."""
        imgui.set_current_context(self.imgui)
        self.draw.release()
        imgui.destroy_context(self.imgui)

    def _io(self) -> imgui.IO:
        imgui.set_current_context(self.imgui)
        return imgui.get_io()
