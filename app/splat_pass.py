"""Gaussians bound to triangles, drawn by OpenGL 4.1.

The Gaussians go to the GPU once. A frame uploads the grid's vertices and the depth order, poses and projects
every Gaussian once in that order (`project.vert`, transform feedback), and blends one quad each, far to near
(`splat.vert`, `splat.frag`), into a float framebuffer of premultiplied colour. What the CPU renderer does and
blending cannot is to stop a pixel once its transmittance is used up.
"""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np
from cap4d.app.shader_source import Constant, build_program

from cap4d.bind import SAFE_NORM2
from cap4d.camera import NEAR, Camera

VERTEX_TEXTURE_WIDTH = 256  # texels; 65536 vertices make it square
OUTPUTS = ("mean2d", "conic", "color_opacity", "axes")  # of project.vert
PROJECTED_BYTES = 13 * 4  # mean2d 2, conic 3, colour and opacity 4, axes 4


@dataclass(frozen=True, eq=False)
class BoundGaussians:
    """N Gaussians in the frames of triangles, with what OpenGL wants of them.

    Args:
        means: float32[N, 3] in units of the triangle's size.
        quats: float32[N, 4] wxyz.
        log_scales: float32[N, 3] in units of the triangle's size.
        opacity_logits: float32[N].
        sh: float32[N, S, 3], S = 1, 4, 9 or 16, DC first.
        triangles: int[N, 3] the grid vertices of each Gaussian's triangle.
        grid_size: Number of grid vertices.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    triangles: np.ndarray
    grid_size: int

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_vec4s(self) -> int:
        """vec4 attributes that hold one Gaussian's coefficients."""
        return -(-self.sh.shape[1] * 3 // 4)

    def attributes(self) -> np.ndarray:
        """float32[N, 11 + 4 sh_vec4s]: mean, opacity, quat, log scale, coefficients (padded with zeros)."""
        opacities = 1 / (1 + np.exp(-self.opacity_logits.astype(np.float64)))
        sh = self.sh.reshape(len(self), -1)
        columns = (self.means, opacities[:, None], self.quats, self.log_scales, sh)
        packed = np.concatenate(columns, 1).astype(np.float32)
        return np.pad(packed, ((0, 0), (0, 11 + 4 * self.sh_vec4s - packed.shape[1])))


class SplatPass:
    """Draws one avatar's Gaussians. Owns its buffers and framebuffer; lives in one context and thread.

    Args:
        ctx: OpenGL 4.1 or newer.
        gaussians: What to draw.
        texture_type: "f4", or "f2" for half the bandwidth at 57 dB of PSNR.
    """

    def __init__(self, ctx: moderngl.Context, gaussians: BoundGaussians, *, texture_type: str = "f4") -> None:
        self.ctx = ctx
        self.gaussians = len(gaussians)
        self.texture_type = texture_type
        self.grid_vertices = _vertex_texture(ctx, gaussians.grid_size)
        self.picture: moderngl.Texture | None = None
        self.target: moderngl.Framebuffer | None = None
        self._counts: moderngl.Texture | None = None
        self._count_target: moderngl.Framebuffer | None = None
        self._counting: moderngl.VertexArray | None = None
        if self.gaussians:
            self._upload(gaussians)

    def _upload(self, gaussians: BoundGaussians) -> None:
        constants = render_constants() | {"SH_COUNT": gaussians.sh.shape[1], "SH_VEC4S": gaussians.sh_vec4s}
        self.project = build_program(self.ctx, "project", constants, varyings=OUTPUTS)
        self.splat = build_program(self.ctx, "splat", constants)
        attributes = self.ctx.buffer(gaussians.attributes())
        triangles = self.ctx.buffer(np.ascontiguousarray(gaussians.triangles, np.uint32))
        self.order = self.ctx.buffer(reserve=4 * self.gaussians, dynamic=True)
        self.projected = self.ctx.buffer(reserve=PROJECTED_BYTES * self.gaussians)
        names = ("mean_opacity", "quat", "log_scale", "sh")
        self.posing = self.ctx.vertex_array(
            self.project,
            [(attributes, f"4f 4f 3f {4 * gaussians.sh_vec4s}f", *names), (triangles, "3u", "triangle")],
            index_buffer=self.order,
            index_element_size=4,
        )
        self.drawing = self.ctx.vertex_array(self.splat, [(self.projected, "2f 3f 4f 4f/i", *OUTPUTS)])

    def draw(self, vertices: np.ndarray, order: np.ndarray, camera: Camera) -> moderngl.Texture:
        """Draws a frame.

        Args:
            vertices: float32[G, 3] the grid's vertices in the world, m.
            order: uint32[N] the Gaussians from near to far.
            camera: Where from, and the picture's size.
        Returns:
            The picture: premultiplied RGBA, row 0 on top. Valid until the next call.
        """
        self._resize(camera.width, camera.height)
        self.target.use()
        self.target.clear()
        if self.gaussians:
            self._project(vertices, order, camera)
            self._blend(camera)
        return self.picture

    def count(self) -> moderngl.Texture:
        """How many Gaussians each pixel of the last picture takes, hidden ones too: float32, row 0 on top.

        Changes the framebuffer in use. Valid until the next call.
        """
        size = self.picture.size
        if self._counts is None or self._counts.size != size:
            self._counts = self.ctx.texture(size, 1, dtype="f4")
            self._counts.repeat_x = self._counts.repeat_y = False
            self._count_target = self.ctx.framebuffer(self._counts)
        self._count_target.use()
        self._count_target.clear()
        if self.gaussians:
            self._add_up(size)
        return self._counts

    def _add_up(self, size: tuple[int, int]) -> None:
        if self._counting is None:
            program = build_program(self.ctx, "count", render_constants(), vertex="splat")
            self._counting = self.ctx.vertex_array(program, [(self.projected, "2f 3f 4f 4f/i", *OUTPUTS)])
        self._counting.program["image_size"] = size
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.ONE, moderngl.ONE
        self._counting.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=self.gaussians)

    def read(self) -> np.ndarray:
        """float32[H, W, 4] the picture, premultiplied."""
        flat = np.frombuffer(self.picture.read(), np.float32 if self.texture_type == "f4" else np.float16)
        return flat.reshape(self.picture.height, self.picture.width, 4).astype(np.float32)

    def _resize(self, width: int, height: int) -> None:
        if self.picture is not None and self.picture.size == (width, height):
            return
        self.picture = self.target = None
        self.ctx.gc()
        self.picture = self.ctx.texture((width, height), 4, dtype=self.texture_type)
        self.picture.repeat_x = self.picture.repeat_y = False
        self.target = self.ctx.framebuffer(self.picture)

    def _project(self, vertices: np.ndarray, order: np.ndarray, camera: Camera) -> None:
        padded = np.zeros((*self.grid_vertices.size[::-1], 3), np.float32)
        padded.reshape(-1, 3)[: len(vertices)] = vertices
        self.grid_vertices.write(padded)
        self.order.write(np.ascontiguousarray(order[::-1], np.uint32))
        self.grid_vertices.use(0)
        set_camera(self.project, camera)
        self.posing.transform(self.projected, moderngl.POINTS)

    def _blend(self, camera: Camera) -> None:
        self.splat["image_size"] = camera.width, camera.height
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        self.drawing.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=self.gaussians)


def render_constants() -> dict[str, Constant]:
    """What decides a pixel: names and values of src/cpp/constants.h, which gives the reasons."""
    return {
        "NEAR": NEAR,
        "LOW_PASS": 0.3,
        "JACOBIAN_MARGIN": 0.3,
        "ALPHA_MIN": 1 / 255,
        "ALPHA_MAX": 0.99,
        "SAFE_NORM2": SAFE_NORM2,
        "QUAT_MIN": 1e-12,
    }


def _vertex_texture(ctx: moderngl.Context, count: int) -> moderngl.Texture:
    rows = max(1, -(-count // VERTEX_TEXTURE_WIDTH))
    texture = ctx.texture((VERTEX_TEXTURE_WIDTH, rows), 3, dtype="f4")
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    return texture


def set_camera(program: moderngl.Program, camera: Camera) -> None:
    """Only what the compiled program reads: a driver may drop the rest."""
    K = camera.K
    values = {
        "viewmat": camera.viewmat.T.astype(np.float32),
        "eye": camera.position.astype(np.float32),
        "intrinsics": np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32),
        "image_size": np.array([camera.width, camera.height], np.float32),
    }
    for name, value in values.items():
        if name in program:
            program[name].write(value.tobytes())
