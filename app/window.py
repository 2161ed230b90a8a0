"""The viewer's window: GLFW, its OpenGL context and its input."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Protocol

import glfw
import moderngl
from cap4d.app.gl_context import GlUnavailableError, window_context

from cap4d.errors import Cap4dError

KEY_NAMES = {
    value: name.removeprefix("KEY_") for name, value in vars(glfw).items() if name.startswith("KEY_")
}
"""glfw's number of a key -> its name: `SPACE`, `A`, `F1`."""


class Listener(Protocol):
    """Whom the window tells what happens to it. Positions are window units, y down."""

    def pointer(self, x: float, y: float) -> None: ...

    def button(self, button: int, down: bool, modifiers: int) -> None: ...

    def wheel(self, dx: float, dy: float) -> None: ...

    def key(self, key: int, action: int, modifiers: int) -> None: ...

    def text(self, codepoint: int) -> None: ...

    def focus(self, focused: bool) -> None: ...

    def dropped(self, paths: list[Path]) -> None: ...

    def damaged(self) -> None:
        """What is on screen is lost, or has another size."""


class DisplayUnavailableError(Cap4dError):
    """There is no display to open a window on."""


class Window:
    """A GLFW window with a current OpenGL 4.1 context; closes at the end of its `with` block.

    Args:
        title: Of the window.
        width, height: Window units (not pixels).
    Raises:
        DisplayUnavailableError: GLFW finds no display.
        GlUnavailableError: The display offers no OpenGL 4.1.
    """

    def __init__(self, title: str, width: int, height: int) -> None:
        self._last_error = ""
        self._cursors: dict[int | None, object] = {}
        self._windowed: tuple[int, int, int, int] | None = None  # place and size to go back to
        glfw.set_error_callback(self._on_error)
        if not glfw.init():
            raise DisplayUnavailableError(f"window: expected a display, found none ({self._last_error})")
        hints = {
            glfw.CONTEXT_VERSION_MAJOR: 4,
            glfw.CONTEXT_VERSION_MINOR: 1,
            glfw.OPENGL_PROFILE: glfw.OPENGL_CORE_PROFILE,
            glfw.OPENGL_FORWARD_COMPAT: True,
            glfw.SCALE_TO_MONITOR: True,
        }
        for hint, value in hints.items():
            glfw.window_hint(hint, value)
        self.handle = glfw.create_window(width, height, title, None, None)
        if not self.handle:
            glfw.terminate()
            raise GlUnavailableError(f"window: expected OpenGL 4.1 core, found none ({self._last_error})")
        glfw.make_context_current(self.handle)
        glfw.swap_interval(1)
        self.ctx: moderngl.Context = window_context()

    def __enter__(self) -> Window:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        glfw.destroy_window(self.handle)
        glfw.terminate()

    @property
    def size(self) -> tuple[int, int]:
        """Window units."""
        return glfw.get_window_size(self.handle)

    @property
    def framebuffer_size(self) -> tuple[int, int]:
        """Pixels; (0, 0) while minimised."""
        return glfw.get_framebuffer_size(self.handle)

    @property
    def scale(self) -> float:
        """Window units per unit of design: above 1 where a dense display's pixels are the units."""
        content, _ = glfw.get_window_content_scale(self.handle)
        pixels = self.framebuffer_size[0] / max(self.size[0], 1)
        return min(max(content / max(pixels, 1.0), 0.5), 4.0)

    @property
    def refresh_rate(self) -> float:
        """Pictures a second that the display shows."""
        monitor = glfw.get_primary_monitor()
        mode = glfw.get_video_mode(monitor) if monitor else None
        return float(mode.refresh_rate) if mode is not None and mode.refresh_rate > 0 else 60.0

    @property
    def should_close(self) -> bool:
        return glfw.window_should_close(self.handle)

    def use(self) -> tuple[int, int]:
        """Makes the window the render target; returns its pixels."""
        size = self.framebuffer_size
        self.ctx.screen.use()
        self.ctx.viewport = (0, 0, *size)
        self.ctx.scissor = None
        return size

    def clear(self) -> None:
        """Shows an empty window at once."""
        self.use()
        self.ctx.clear(1.0, 1.0, 1.0, 1.0)
        self.swap()
        self.poll()

    def swap(self) -> None:
        glfw.swap_buffers(self.handle)

    def poll(self) -> None:
        """Handles the input that has come."""
        glfw.poll_events()

    def wait(self, seconds: float) -> None:
        """Sleeps until there is input, at most `seconds`."""
        glfw.wait_events_timeout(max(seconds, 1e-4))

    def connect(self, listener: Listener) -> None:
        """Tells `listener` what mouse, keyboard and system do."""
        handle = self.handle
        glfw.set_cursor_pos_callback(handle, lambda _, x, y: listener.pointer(x, y))
        glfw.set_mouse_button_callback(
            handle, lambda _, button, action, mods: listener.button(button, action == glfw.PRESS, mods)
        )
        glfw.set_scroll_callback(handle, lambda _, dx, dy: listener.wheel(dx, dy))
        glfw.set_key_callback(handle, lambda _, key, code, action, mods: listener.key(key, action, mods))
        glfw.set_char_callback(handle, lambda _, codepoint: listener.text(codepoint))
        glfw.set_window_focus_callback(handle, lambda _, focused: listener.focus(bool(focused)))
        glfw.set_drop_callback(handle, lambda _, paths: listener.dropped([Path(p) for p in paths]))
        glfw.set_window_refresh_callback(handle, lambda _: listener.damaged())
        glfw.set_framebuffer_size_callback(handle, lambda _, width, height: listener.damaged())
        listener.pointer(*glfw.get_cursor_pos(handle))

    def copied(self) -> str:
        """The text in the clipboard; empty where there is none."""
        return (glfw.get_clipboard_string(self.handle) or b"").decode(errors="replace")

    def copy(self, text: str) -> None:
        """Puts text into the clipboard."""
        glfw.set_clipboard_string(self.handle, text)

    def show_cursor(self, shape: int | None) -> None:
        """Gives the pointer one of glfw's shapes; None is the arrow."""
        if shape not in self._cursors:
            self._cursors[shape] = None if shape is None else glfw.create_standard_cursor(shape)
        glfw.set_cursor(self.handle, self._cursors[shape])

    def set_title(self, title: str) -> None:
        glfw.set_window_title(self.handle, title)

    def set_vsync(self, on: bool) -> None:
        """Whether `swap` waits for the display."""
        glfw.swap_interval(int(on))

    def toggle_fullscreen(self) -> None:
        """Between the whole display and the window as it was."""
        if self._windowed is not None:
            x, y, width, height = self._windowed
            self._windowed = None
            glfw.set_window_monitor(self.handle, None, x, y, width, height, glfw.DONT_CARE)
            return
        monitor = glfw.get_primary_monitor()
        if monitor:
            self._windowed = (*glfw.get_window_pos(self.handle), *self.size)
            mode = glfw.get_video_mode(monitor)
            glfw.set_window_monitor(
                self.handle, monitor, 0, 0, mode.size.width, mode.size.height, mode.refresh_rate
            )

    def close(self) -> None:
        """Asks the window to close."""
        glfw.set_window_should_close(self.handle, True)

    def _on_error(self, code: int, description: bytes) -> None:
        self._last_error = description.decode(errors="replace")
