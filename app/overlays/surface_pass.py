"""Draws the UV grid's posed surface into a picture of its own, to be laid over the splats."""

from __future__ import annotations

from collections.abc import Mapping

import moderngl
import numpy as np
from cap4d.app.gl_context import is_software
from cap4d.app.shader_source import build_program
from cap4d.app.splat_pass import set_camera

from cap4d.camera import NEAR, Camera
from cap4d.rig.grid import UvGrid

FAR = 100.0  # m
TRIANGLE = ((0, 0), (1, 0), (1, 1))  # rows and columns of a mesh's triangle; see overlay_wire.frag
SAMPLES = 4  # per pixel, so that the surface's outline is as smooth as its lines; twice the time on a CPU


class SurfacePass:
    """Several overlays of one surface lie on one another; only what is nearest to the camera shows.

    Args:
        ctx: OpenGL 4.1 or newer.
        grid: Of the avatar.
        samples: Per pixel, 0 for no smoothing; None: `SAMPLES` where a GPU draws.
    """

    def __init__(self, ctx: moderngl.Context, grid: UvGrid, *, samples: int | None = None) -> None:
        self.ctx = ctx
        self.picture: moderngl.Texture | None = None
        wanted = (0 if is_software(ctx) else SAMPLES) if samples is None else samples
        self._samples = min(wanted, ctx.max_samples)
        self._target = self._resolved = None
        # Triangles of a mesh share no corners here: each has sides along a row, a column and a diagonal.
        self._corners = grid.faces.ravel() if grid.is_mesh else None
        points = 3 * len(grid.faces) if grid.is_mesh else len(grid)
        pixels = np.tile(TRIANGLE, (len(grid.faces), 1)) if grid.is_mesh else grid.pixels
        faces = np.arange(points) if grid.is_mesh else grid.faces
        self._positions = ctx.buffer(reserve=12 * points, dynamic=True)
        self._values = ctx.buffer(bytes(4 * points), dynamic=True)
        self._pixels = ctx.buffer(np.ascontiguousarray(pixels, np.float32))
        self._faces = ctx.buffer(np.ascontiguousarray(faces, np.uint32))
        self._size = grid.size
        self._arrays: dict[str, moderngl.VertexArray] = {}

    def begin(self, vertices: np.ndarray, camera: Camera) -> None:
        """Starts an empty picture.

        Args:
            vertices: float32[G, 3] the posed grid, m.
            camera: Where from, and the picture's size.
        """
        self._resize(camera.width, camera.height)
        self._positions.write(self._at_corners(vertices))
        self._camera, self._drawn = camera, 0
        self._target.use()
        self._target.clear()

    def draw(
        self, name: str, *, values: np.ndarray | None = None, uniforms: Mapping[str, object] | None = None
    ) -> None:
        """Adds the surface as `name.frag` paints it, over those before it.

        Args:
            values: float32[G], or None.
            uniforms: Of the fragment shader.
        """
        array = self._array(name)
        if values is not None:
            self._values.write(self._at_corners(values))
        set_camera(array.program, self._camera)
        for key, value in (uniforms or {}).items():
            array.program[key] = value
        self.ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND if self._drawn else moderngl.DEPTH_TEST)
        self.ctx.depth_func = "<=" if self._drawn else "<"
        self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        array.render(moderngl.TRIANGLES)
        self._drawn += 1

    def end(self) -> moderngl.Texture:
        """The picture: premultiplied sRGB, row 0 on top. Valid until the next `begin`."""
        self.ctx.copy_framebuffer(self._resolved, self._target)
        return self.picture

    @property
    def grid_size(self) -> int:
        """Pixels a side of the grid."""
        return self._size

    def _at_corners(self, values: np.ndarray) -> np.ndarray:
        """What the buffers hold of float32[G, ...]."""
        return np.ascontiguousarray(values if self._corners is None else values[self._corners], np.float32)

    def _array(self, name: str) -> moderngl.VertexArray:
        if name not in self._arrays:
            program = build_program(self.ctx, name, {"NEAR": NEAR, "FAR": FAR}, vertex="overlay")
            streams = {"position": (self._positions, "3f"), "pixel": (self._pixels, "2f")}
            streams |= {"value": (self._values, "1f")}
            used = [(*streams[key], key) for key in streams if key in program]
            self._arrays[name] = self.ctx.vertex_array(
                program, used, index_buffer=self._faces, index_element_size=4
            )
        return self._arrays[name]

    def _resize(self, width: int, height: int) -> None:
        if self.picture is not None and self.picture.size == (width, height):
            return
        self.picture = self._target = self._resolved = None
        self.ctx.gc()
        size, samples = (width, height), self._samples
        self.picture = self.ctx.texture(size, 4)
        self.picture.repeat_x = self.picture.repeat_y = False
        self._resolved = self.ctx.framebuffer(self.picture)
        color = self.ctx.renderbuffer(size, 4, samples=samples)
        self._target = self.ctx.framebuffer(color, self.ctx.depth_renderbuffer(size, samples=samples))
