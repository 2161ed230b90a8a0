"""A player in a real window, worked by a real X server: for tests that run under xvfb-run."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from cap4d.app.live import LivePlayer, open_viewer
from cap4d.app.options import parse_options
from cap4d.app.window import Window

PATIENCE = 20.0  # s for what should take a moment


class WatchedWindow(Window):
    """Keeps the pixels of the last picture: uint8[H, W, 3], row 0 on top."""

    picture: np.ndarray

    def swap(self) -> None:
        width, height = self.framebuffer_size
        pixels = self.ctx.screen.read(viewport=(width, height), components=3, alignment=1)
        self.picture = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)[::-1]
        super().swap()


def open_player(window: Window, arguments: list[str], avatar: Path) -> LivePlayer:
    """`cap4d-view` with these arguments, in `window`."""
    options = parse_options(arguments)
    return LivePlayer(window, open_viewer(options.avatar or avatar, options), options.backend)


def pump(player: LivePlayer, until: Callable[[], bool], patience: float = PATIENCE) -> None:
    """Lets the window live until something is so."""
    end = time.monotonic() + patience
    while not until():
        assert time.monotonic() < end, "it took too long"
        player.window.poll()
        if not player.step():
            player.window.wait(0.005)


def pump_for(player: LivePlayer, seconds: float) -> None:
    """Lets the window live for a while."""
    end = time.monotonic() + seconds
    pump(player, lambda: time.monotonic() >= end, seconds + PATIENCE)


def xdotool(player: LivePlayer, *words: object) -> None:
    """Sends input through the X server while the window lives, and waits for what it does to be on screen."""
    process = subprocess.Popen(["xdotool", *(str(w) for w in words)])
    pump(player, lambda: process.poll() is not None)
    assert process.returncode == 0, words
    pump_for(player, 0.1)


def drag(player: LivePlayer, start: tuple[float, float], end: tuple[float, float], button: int = 1) -> None:
    """Presses, moves in steps and lets go, at positions in the window."""
    import glfw

    left, top = glfw.get_window_pos(player.window.handle)
    at = lambda point: ("mousemove", left + round(point[0]), top + round(point[1]))  # noqa: E731
    xdotool(player, *at(start))
    xdotool(player, "mousedown", button)
    for share in (0.3, 0.6, 1.0):
        xdotool(player, *at(tuple(a + share * (b - a) for a, b in zip(start, end, strict=True))))
    xdotool(player, "mouseup", button)
