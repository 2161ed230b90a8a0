"""The picture without the panels: avatar, background and overlays, for the window and for files."""

from __future__ import annotations

import moderngl
import numpy as np
from cap4d.app.background import Backdrop, Background
from cap4d.app.overlays.overlays import Overlays
from cap4d.app.renderers import Renderer

from cap4d.camera import Camera


class Canvas:
    """A framebuffer of its own. Row 0 is the top row.

    Args:
        ctx: OpenGL 4.1 or newer.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.backdrop = Backdrop(ctx)
        self.texture: moderngl.Texture | None = None
        self._target: moderngl.Framebuffer | None = None

    def draw(
        self,
        picture: moderngl.Texture,
        background: Background,
        size: tuple[int, int],
        *,
        overlays: Overlays | None = None,
        renderer: Renderer | None = None,
        camera: Camera | None = None,
    ) -> moderngl.Texture:
        """Draws all of it; valid until the next call.

        Args:
            picture: The avatar, premultiplied.
            size: (width, height) px of the canvas, whatever the picture's.
            overlays, renderer, camera: What lies over it, and what has drawn the picture.
        """
        if self.texture is None or self.texture.size != size:
            self.texture = self._target = None
            self.texture = self.ctx.texture(size, 4)
            self.texture.repeat_x = self.texture.repeat_y = False
            self._target = self.ctx.framebuffer(self.texture)
        self._target.use()
        self.ctx.viewport = (0, 0, *size)
        self.ctx.scissor = None
        self.backdrop.draw(picture, background)
        if overlays is not None and overlays.shown:
            overlays.draw(renderer, camera.resized(*size))
        return self.texture

    def read(self) -> np.ndarray:
        """uint8[H, W, 4] what was drawn; straight alpha only where it is opaque."""
        flat = np.frombuffer(self._target.read(components=4, alignment=1), np.uint8)
        return flat.reshape(*self.texture.size[::-1], 4)
