"""Where the window's input goes: to the panels if they want it, else to the camera and the keys."""

from __future__ import annotations

from pathlib import Path

import glfw
from cap4d.app.controls import Drag
from cap4d.app.gui import Gui
from cap4d.app.shortcuts import action_of
from cap4d.app.viewer import Viewer
from cap4d.app.window import KEY_NAMES

DRAGS = {
    glfw.MOUSE_BUTTON_LEFT: Drag.TURN,
    glfw.MOUSE_BUTTON_RIGHT: Drag.PAN,
    glfw.MOUSE_BUTTON_MIDDLE: Drag.PAN,
}
PAN_PER_STEP = 24.0  # window units that a step of the wheel moves the picture with shift
MOST_DROPPED = 16  # files at a time


class Input:
    """Hears the window (`window.Listener`).

    Args:
        gui: The panels, which come first.
        viewer: Its controls and actions come second.
    """

    def __init__(self, gui: Gui, viewer: Viewer) -> None:
        self.gui, self.viewer = gui, viewer
        self.picture_size = (1, 1)  # of the part of the window that shows the face, window units
        self._shift = False
        self._held: int | None = None  # the button that drags the camera

    def pointer(self, x: float, y: float) -> None:
        self.gui.pointer(x, y)
        self.viewer.controls.move(x, y, self.picture_size)

    def button(self, button: int, down: bool, modifiers: int) -> None:
        """A drag belongs to what it began on until its button is up again, wherever the pointer goes."""
        self.gui.button(button, down)
        if down and self._held is None and button in DRAGS and not self.gui.wants_pointer:
            self._held = button
            self.viewer.controls.press(Drag.PAN if modifiers & glfw.MOD_SHIFT else DRAGS[button])
        elif not down and button == self._held:
            self._held = None
            self.viewer.controls.release()

    def wheel(self, dx: float, dy: float) -> None:
        """Two fingers and the wheel zoom, as a pinch does, which systems send as a wheel with ctrl."""
        self.gui.wheel(dx, dy)
        if self.gui.wants_pointer:
            return
        if self._shift:
            self.viewer.controls.pan(PAN_PER_STEP * dx, PAN_PER_STEP * dy, self.picture_size)
        elif dy:
            self.viewer.controls.scroll(dy)

    def key(self, key: int, action: int, modifiers: int) -> None:
        down = action != glfw.RELEASE
        self.gui.key(key, down, modifiers)
        self._shift = bool(modifiers & glfw.MOD_SHIFT)
        if key in (glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SHIFT):
            self._shift = down  # X11 tells the modifiers as they were before
        if not down or self.gui.wants_keys:
            return
        ctrl = bool(modifiers & (glfw.MOD_CONTROL | glfw.MOD_SUPER))
        wanted = action_of(KEY_NAMES.get(key, ""), ctrl=ctrl, repeated=action == glfw.REPEAT)
        if wanted is not None:
            self.viewer.act(wanted)

    def text(self, codepoint: int) -> None:
        self.gui.text(codepoint)

    def focus(self, focused: bool) -> None:
        """Without the keyboard no key's end would be heard."""
        self.gui.focus(focused)
        if not focused:
            self._shift, self._held = False, None
            self.viewer.controls.release()

    def dropped(self, paths: list[Path]) -> None:
        self.gui.touch()
        for path in paths[:MOST_DROPPED]:
            self.viewer.open(path)

    def damaged(self) -> None:
        self.gui.touch()
