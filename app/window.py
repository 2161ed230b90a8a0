"""The viewer's window: GLFW, its OpenGL context and its input."""

from __future__ import annotations

import time
from types import TracebackType

import glfw
import moderngl
from cap4d.app.controls import Controls, Drag
from cap4d.app.gl_context import GlUnavailableError, window_context

from cap4d.errors import Cap4dError

KEYS = {
    glfw.KEY_SPACE: "space",
    glfw.KEY_LEFT: "left",
    glfw.KEY_RIGHT: "right",
    glfw.KEY_ESCAPE: "escape",
    glfw.KEY_R: "r",
    glfw.KEY_H: "h",
    glfw.KEY_Q: "q",
}
DRAGS = {
    glfw.MOUSE_BUTTON_LEFT: Drag.TURN,
    glfw.MOUSE_BUTTON_RIGHT: Drag.PAN,
    glfw.MOUSE_BUTTON_MIDDLE: Drag.PAN,
}


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

    def connect(self, controls: Controls) -> None:
        """Lets mouse and keyboard work `controls`."""
        handle = self.handle
        controls.move(*glfw.get_cursor_pos(handle), self._safe_size())
        glfw.set_mouse_button_callback(handle, lambda _, *event: _press(controls, *event))
        glfw.set_cursor_pos_callback(handle, lambda _, x, y: controls.move(x, y, self._safe_size()))
        glfw.set_scroll_callback(handle, lambda _, dx, dy: controls.scroll(dy))
        glfw.set_key_callback(handle, lambda _, *event: _key(controls, *event))

    def _safe_size(self) -> tuple[int, int]:
        width, height = self.size
        return max(width, 1), max(height, 1)

    def _on_error(self, code: int, description: bytes) -> None:
        self._last_error = description.decode(errors="replace")


def _press(controls: Controls, button: int, action: int, modifiers: int) -> None:
    if action == glfw.PRESS and button in DRAGS:
        controls.press(Drag.PAN if modifiers & glfw.MOD_SHIFT else DRAGS[button])
    elif action == glfw.RELEASE:
        controls.release()


def _key(controls: Controls, key: int, scancode: int, action: int, modifiers: int) -> None:
    if action in (glfw.PRESS, glfw.REPEAT) and key in KEYS:
        controls.key(KEYS[key], time.perf_counter())
