"""How many Gaussians a pixel takes, hidden ones too, as a heat map."""

from __future__ import annotations

import moderngl
import numpy as np
from cap4d.app.overlays.color_map import color_map
from cap4d.app.overlays.legend import Legend, rounded_up, ticks
from cap4d.app.renderers import GlRenderer, Renderer
from cap4d.app.shader_source import build_program

MEASURE_EVERY = 30  # pictures, between looks at the largest number
SHARE = 99.5  # per cent of the pixels that are within the colours


class DensityOverlay:
    """The numbers come from where the picture does: the splat pass, or the CPU's tile lists."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.limit = 1.0
        self.colors = color_map("magma")
        self.program = build_program(ctx, "heat", vertex="present")
        self.program["counts"], self.program["color_map"] = 0, 1
        self.array = ctx.vertex_array(self.program, [])
        self._map = color_texture(ctx, self.colors)
        self._counts: moderngl.Texture | None = None
        self._pictures = 0

    @property
    def legend(self) -> Legend:
        return Legend("Gaussians per pixel", self.colors, ticks(self.limit))

    def counts(self, renderer: Renderer) -> moderngl.Texture:
        """float32 of the renderer's last picture; changes the framebuffer in use."""
        if isinstance(renderer, GlRenderer):
            return renderer.splats.count()
        width, height = renderer.picture.size
        numbers = np.empty((height, width), np.uint16)
        renderer.avatar.splatter.count(numbers, renderer.avatar.threads)
        if self._counts is None or self._counts.size != (width, height):
            self._counts = self.ctx.texture((width, height), 1, dtype="f4")
            self._counts.repeat_x = self._counts.repeat_y = False
        self._counts.write(numbers.astype(np.float32))
        return self._counts

    def draw(self, counts: moderngl.Texture, *, upright: bool) -> None:
        """Over what the framebuffer in use holds."""
        if self._pictures % MEASURE_EVERY == 0:
            self._measure(counts)
        self._pictures += 1
        self.program["flip"] = (1, -1) if upright else (1, 1)
        self.program["limit"] = self.limit
        counts.use(0)
        self._map.use(1)
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        self.array.render(moderngl.TRIANGLES, vertices=3)

    def _measure(self, counts: moderngl.Texture) -> None:
        numbers = np.frombuffer(counts.read(), np.float32)
        seen = numbers[numbers > 0]
        if len(seen):
            self.limit = rounded_up(float(np.percentile(seen, SHARE)))


def color_texture(ctx: moderngl.Context, colors: np.ndarray) -> moderngl.Texture:
    """uint8[C, 3] as a row of texels, linear in between."""
    texture = ctx.texture((len(colors), 1), 3, np.ascontiguousarray(colors), alignment=1)
    texture.repeat_x = texture.repeat_y = False
    return texture
