"""Two ways to a picture of an avatar behind one call: OpenGL, and the CPU renderer with a texture."""

from __future__ import annotations

from typing import Protocol

import moderngl
import numpy as np
from cap4d.app.background import WHITE, Backdrop, Color
from cap4d.app.gl_context import GlUnavailableError, headless_context, is_software
from cap4d.app.splat_pass import BoundGaussians, SplatPass

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.player.avatar import Avatar


class Renderer(Protocol):
    """Draws one avatar."""

    name: str
    avatar: Avatar
    vertices: np.ndarray
    """float32[G, 3] m: the posed grid of the last picture; the call after the next overwrites it."""

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
        self.backdrop = Backdrop(ctx)
        self.target: moderngl.Framebuffer | None = None
        self.vertices = np.zeros((0, 3), np.float32)

    def texture(self, frame: Frame, camera: Camera) -> moderngl.Texture:
        """See `Renderer`."""
        avatar, stages = self.avatar, self.avatar.stages
        self.vertices = vertices = avatar.move(frame)
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
            self.backdrop.draw(picture, background)
            flat = np.frombuffer(self.target.read(components=4), np.uint8)
        return flat.reshape(camera.height, camera.width, 4)


class CpuRenderer:
    """cap4d's own renderer; the texture is what a window shows of it.

    Args:
        ctx: Any OpenGL context.
        avatar: Its `stages` receive the times.
        background: A colour that is already behind the picture, which then is opaque; None: it is not.
    """

    name = "cpu"

    def __init__(self, ctx: moderngl.Context, avatar: Avatar, background: Color | None = WHITE) -> None:
        self.ctx, self.avatar, self.background = ctx, avatar, background
        self.picture: moderngl.Texture | None = None
        self.vertices = np.zeros((0, 3), np.float32)

    def texture(self, frame: Frame, camera: Camera) -> moderngl.Texture:
        """See `Renderer`."""
        self.vertices = self.avatar.move(frame)
        image = self.avatar.splat(self.vertices, camera, background=self.background, alpha="premultiplied")
        size = camera.width, camera.height
        if self.picture is None or self.picture.size != size:
            self.picture = self.ctx.texture(size, 4)
            self.picture.repeat_x = self.picture.repeat_y = False
        self.picture.write(image)
        return self.picture


def open_gl(wanted: str, avatar: Avatar) -> GlRenderer | None:
    """OpenGL without a window, its context this thread's; None: the CPU is to draw.

    Args:
        wanted: `cpu`, `gl`, or `auto`: OpenGL where a GPU is behind it, since a software driver takes several
            times as long as the CPU renderer.
    Raises:
        GlUnavailableError: `gl` is wanted and not there.
    """
    if wanted == "cpu":
        return None
    try:
        ctx = headless_context()
    except GlUnavailableError:
        if wanted == "gl":
            raise
        return None
    if wanted == "auto" and is_software(ctx):
        ctx.release()
        return None
    return GlRenderer(ctx, avatar)


def bound_gaussians(avatar: Avatar) -> BoundGaussians:
    """The avatar's Gaussians as `SplatPass` takes them, in the order of its splatter."""
    bundle, order = avatar.bundle, avatar.gaussian_order
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    raw = {name: getattr(bundle, name)[order] for name in names}
    triangles = bundle.grid.faces[bundle.binding[order]]
    return BoundGaussians(**raw, triangles=triangles, grid_size=len(bundle.grid))
