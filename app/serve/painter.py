"""Pictures of an avatar from several places at one moment, on the CPU or the GPU. Used by one thread."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from cap4d.app.background import Color
from cap4d.app.renderers import GlRenderer, open_gl

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.player.avatar import Avatar


class Painter(Protocol):
    """Poses once, paints as often as there are views."""

    name: str

    def pose(self, frame: Frame) -> None: ...

    def paint(self, camera: Camera, background: Color) -> np.ndarray:
        """uint8[H, W, 4] of the last pose, opaque."""


class CpuPainter:
    """cap4d's own renderer."""

    name = "cpu"

    def __init__(self, avatar: Avatar) -> None:
        self.avatar = avatar
        self._vertices: np.ndarray | None = None

    def pose(self, frame: Frame) -> None:
        """See `Painter`."""
        self._vertices = self.avatar.move(frame)

    def paint(self, camera: Camera, background: Color) -> np.ndarray:
        """See `Painter`."""
        return self.avatar.splat(self._vertices, camera, background=background)


class GlPainter:
    """OpenGL without a window; its context belongs to the thread that makes it."""

    name = "gl"

    def __init__(self, renderer: GlRenderer) -> None:
        self.renderer = renderer
        self._frame: Frame | None = None

    def pose(self, frame: Frame) -> None:
        """See `Painter`; the renderer poses by itself."""
        self._frame = frame

    def paint(self, camera: Camera, background: Color) -> np.ndarray:
        """See `Painter`."""
        return self.renderer.draw(self._frame, camera, background=background)


def choose_painter(wanted: str, avatar: Avatar) -> Painter:
    """See `open_gl`."""
    renderer = open_gl(wanted, avatar)
    return CpuPainter(avatar) if renderer is None else GlPainter(renderer)
