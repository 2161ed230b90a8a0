"""Dear ImGui's geometry drawn through moderngl.

imgui-bundle's own backends want PyOpenGL, and moderngl-window's does not know the textures of Dear
ImGui 1.92, so the draw backend is here.
"""

from __future__ import annotations

import ctypes

import glfw  # noqa: F401  before imgui_bundle, which otherwise loads its own, X11-only GLFW
import moderngl
from cap4d.app.shader_source import build_program
from imgui_bundle import imgui


class GuiDraw:
    """Draws what a Dear ImGui context made. Its textures and buffers go with the GL context.

    Args:
        ctx: OpenGL 4.1 or newer.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.textures: dict[int, moderngl.Texture] = {}
        self._used = -1  # the texture in use
        self.program = build_program(ctx, "panel")
        self.vertices = ctx.buffer(reserve=1 << 18, dynamic=True)
        self.indices = ctx.buffer(reserve=1 << 16, dynamic=True)
        layout = [(self.vertices, "2f 2f 4f1", "position", "uv", "color")]
        self.array = ctx.vertex_array(
            self.program, layout, index_buffer=self.indices, index_element_size=imgui.INDEX_SIZE
        )

    def draw(self, data: imgui.ImDrawData) -> None:
        """Draws into the framebuffer in use, over what is there."""
        for texture in data.textures:
            self._update(texture)
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self.program["display"] = *data.display_pos, *data.display_size
        self._used = -1
        for commands in data.cmd_lists:
            self._upload(commands)
            for command in commands.cmd_buffer:
                self._draw_command(command, data)
        self.ctx.scissor = None

    def release(self) -> None:
        """Tells Dear ImGui that its textures are gone."""
        for texture in imgui.get_platform_io().textures:
            texture.set_status(imgui.ImTextureStatus.destroyed)

    def _draw_command(self, command: imgui.ImDrawCmd, data: imgui.ImDrawData) -> None:
        scissor = _scissor(command.clip_rect, data)
        if not (scissor[2] and scissor[3] and command.elem_count):
            return
        self.ctx.scissor = scissor
        if command.get_tex_id() != self._used:
            self._used = command.get_tex_id()
            self.textures[self._used].use(0)
        self.array.render(moderngl.TRIANGLES, vertices=command.elem_count, first=command.idx_offset)

    def _update(self, texture: imgui.ImTextureData) -> None:
        """Creates or renews a texture whose pixels changed (the font atlas grows as glyphs are used)."""
        status = imgui.ImTextureStatus
        if texture.status in (status.want_create, status.want_updates):
            pixels = texture.get_pixels_array().tobytes()
            size = texture.width, texture.height
            known = self.textures.get(texture.unique_id)
            if known is not None and known.size == size:
                known.write(pixels)
            else:
                self.textures[texture.unique_id] = self.ctx.texture(size, texture.bytes_per_pixel, pixels)
            texture.set_tex_id(texture.unique_id)
            texture.set_status(status.ok)
        elif texture.status == status.want_destroy:
            self.textures.pop(texture.unique_id, None)
            texture.set_status(status.destroyed)

    def _upload(self, commands: imgui.ImDrawList) -> None:
        vertices = _bytes(commands.vtx_buffer, imgui.VERTEX_SIZE)
        indices = _bytes(commands.idx_buffer, imgui.INDEX_SIZE)
        for buffer, content in ((self.vertices, vertices), (self.indices, indices)):
            buffer.orphan(max(buffer.size, len(content)))
            buffer.write(content)


def _bytes(buffer: object, item_size: int) -> memoryview:
    """Dear ImGui's own memory, valid until its next frame."""
    size = buffer.size() * item_size
    return memoryview((ctypes.c_char * size).from_address(buffer.data_address())) if size else memoryview(b"")


def _scissor(clip: imgui.ImVec4, data: imgui.ImDrawData) -> tuple[int, int, int, int]:
    """Dear ImGui's clip rectangle (window units, y down) in framebuffer pixels, y up, none below 0."""
    scale = data.framebuffer_scale
    width, height = data.display_size.x * scale.x, data.display_size.y * scale.y
    left = max((clip.x - data.display_pos.x) * scale.x, 0)
    top = max((clip.y - data.display_pos.y) * scale.y, 0)
    right = min((clip.z - data.display_pos.x) * scale.x, width)
    bottom = min((clip.w - data.display_pos.y) * scale.y, height)
    return int(left), int(height - bottom), max(0, int(right - left)), max(0, int(bottom - top))
