"""Two ways to a picture of an avatar behind one call: OpenGL, and the CPU renderer with a texture."""

from __future__ import annotations

from typing import Protocol

import moderngl
import numpy as np
from cap4d.app.shader_source import build_program
from cap4d.app.splat_pass import BoundGaussians, SplatPass

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.player.avatar import Avatar

Color = tuple[float, float, float]
WHITE: Color = (1.0, 1.0, 1.0)


class Renderer(Protocol):
    """Draws one avatar."""

    name: str
    avatar: Avatar

    def texture(self, frame: Frame, camera: Camera) -> moderngl.Texture:
        """The picture as a texture: premultiplied sRGB, row 0 on top. Valid until the next call."""
        ...


class GlRenderer:
    """Rig and network on the CPU, Gaussians on the GPU.

    Args:
        ctx: OpenGL 4.1 or newer.
        avatar: Its `stages` receive the times of `bind`, `sort` and `splat`.
    """

    name = "gl"

    def __init__(self, ctx: moderngl.Context, avatar: Avatar) -> None:
        self.ctx, self.avatar = ctx, avatar
        self.splats = SplatPass(ctx, bound_gaussians(avatar))
        self.overlay = Overlay(ctx)
        self.target: moderngl.Framebuffer | None = None

    def texture(self, frame: Frame, camera: Camera) -> moderngl.Texture:
        """See `Renderer`."""
        avatar, stages = self.avatar, self.avatar.stages
        vertices = avatar.move(frame)
        order = avatar.splatter.order(camera.viewmat, vertices, avatar.threads)
        for stage in ("bind", "sort"):
            stages.add(stage, avatar.splatter.seconds[stage])
        with stages.time("splat"):
            picture = self.splats.draw(vertices, order, camera)
            self.ctx.finish()
        return picture

    def draw(self, frame: Frame, camera: Camera, *, background: Color = WHITE) -> np.ndarray:
        """uint8[H, W, 4]: the same call and picture as `Avatar.draw`."""
        picture = self.texture(frame, camera)
        with self.avatar.stages.time("encode"):
            if self.target is None or self.target.size != picture.size:
                self.target = self.ctx.simple_framebuffer(picture.size)
            self.target.use()
            self.overlay.draw(picture, background)
            flat = np.frombuffer(self.target.read(components=4), np.uint8)
        return flat.reshape(camera.height, camera.width, 4)


class CpuRenderer:
    """cap4d's own renderer; the texture is what a window shows of it.

    Args:
        ctx: Any OpenGL context.
        avatar: Its `stages` receive the times.
        background: The picture's.
    """

    name = "cpu"

    def __init__(self, ctx: moderngl.Context, avatar: Avatar, background: Color = WHITE) -> None:
        self.ctx, self.avatar, self.background = ctx, avatar, background
        self.picture: moderngl.Texture | None = None

    def texture(self, frame: Frame, camera: Camera) -> moderngl.Texture:
        """See `Renderer`."""
        image = self.avatar.draw(frame, camera, background=self.background)
        size = camera.width, camera.height
        if self.picture is None or self.picture.size != size:
            self.picture = self.ctx.texture(size, 4)
            self.picture.repeat_x = self.picture.repeat_y = False
        self.picture.write(image)
        return self.picture


class Overlay:
    """Lays a premultiplied texture over a plain colour, filling the framebuffer in use."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.program = build_program(ctx, "present")
        self.array = ctx.vertex_array(self.program, [])

    def draw(self, picture: moderngl.Texture, background: Color, *, upright: bool = False) -> None:
        """`upright`: for a window, whose row 0 is at the bottom; otherwise row 0 is the top row."""
        self.ctx.enable_only(moderngl.NOTHING)
        self.program["flip"] = (1, -1) if upright else (1, 1)
        self.program["background"] = background
        picture.use(0)
        self.array.render(moderngl.TRIANGLES, vertices=3)


def bound_gaussians(avatar: Avatar) -> BoundGaussians:
    """The avatar's Gaussians as `SplatPass` takes them, in the order of its splatter."""
    bundle, order = avatar.bundle, avatar.gaussian_order
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    raw = {name: getattr(bundle, name)[order] for name in names}
    triangles = bundle.grid.faces[bundle.binding[order]]
    return BoundGaussians(**raw, triangles=triangles, grid_size=len(bundle.grid))
