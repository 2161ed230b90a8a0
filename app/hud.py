"""The read-out over the picture: Dear ImGui's geometry drawn through moderngl.

imgui-bundle's own backends want PyOpenGL, and moderngl-window's does not know the textures of Dear
ImGui 1.92, so the draw backend is here.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import glfw  # noqa: F401  before imgui_bundle, which otherwise loads its own, X11-only GLFW
import moderngl
from cap4d.app.shader_source import build_program
from imgui_bundle import imgui

MARGIN = 10  # window units
PANEL = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_inputs
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.no_focus_on_appearing
)


class Hud:
    """A panel of text in the top left corner. Owns a Dear ImGui context: call `release` before GL goes."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.imgui = imgui.create_context()
        imgui.style_colors_light()
        imgui.get_style().window_rounding = 6
        imgui.get_style().window_padding = imgui.ImVec2(10, 8)
        io = imgui.get_io()
        io.set_ini_filename("")
        io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
        self.textures: dict[int, moderngl.Texture] = {}
        self.program = build_program(ctx, "hud")
        self.vertices = ctx.buffer(reserve=1 << 16, dynamic=True)
        self.indices = ctx.buffer(reserve=1 << 16, dynamic=True)
        layout = [(self.vertices, "2f 2f 4f1", "position", "uv", "color")]
        self.array = ctx.vertex_array(
            self.program, layout, index_buffer=self.indices, index_element_size=imgui.INDEX_SIZE
        )

    def draw(self, lines: Sequence[str], size: tuple[float, float], scale: tuple[float, float]) -> None:
        """Draws `lines` into the framebuffer in use.

        Args:
            lines: Plain text.
            size: The window, window units.
            scale: Framebuffer pixels per window unit.
        """
        io = imgui.get_io()
        io.display_size, io.display_framebuffer_scale = imgui.ImVec2(*size), imgui.ImVec2(*scale)
        imgui.new_frame()
        imgui.set_next_window_pos(imgui.ImVec2(MARGIN, MARGIN))
        imgui.set_next_window_bg_alpha(0.8)
        imgui.begin("read-out", None, PANEL)
        for line in lines:
            imgui.text_unformatted(line)
        imgui.end()
        imgui.render()
        self._draw(imgui.get_draw_data())

    def release(self) -> None:
        """Ends the Dear ImGui context; its textures go with the GL context."""
        for texture in imgui.get_platform_io().textures:
            texture.set_status(imgui.ImTextureStatus.destroyed)
        imgui.destroy_context(self.imgui)

    def _draw(self, data: imgui.ImDrawData) -> None:
        for texture in data.textures:
            self._update(texture)
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self.program["display"] = *data.display_pos, *data.display_size
        for commands in data.cmd_lists:
            self._upload(commands)
            for command in commands.cmd_buffer:
                self._draw_command(command, data)
        self.ctx.scissor = None

    def _draw_command(self, command: imgui.ImDrawCmd, data: imgui.ImDrawData) -> None:
        self.ctx.scissor = _scissor(command.clip_rect, data)
        self.textures[command.get_tex_id()].use(0)
        self.array.render(moderngl.TRIANGLES, vertices=command.elem_count, first=command.idx_offset)

    def _update(self, texture: imgui.ImTextureData) -> None:
        """Creates or renews a texture whose pixels changed (the font atlas grows as glyphs are used)."""
        status = imgui.ImTextureStatus
        if texture.status in (status.want_create, status.want_updates):
            pixels = texture.get_pixels_array().tobytes()
            size = texture.width, texture.height
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


def _bytes(buffer: object, item_size: int) -> bytes:
    return ctypes.string_at(buffer.data_address(), buffer.size() * item_size) if buffer.size() else b""


def _scissor(clip: imgui.ImVec4, data: imgui.ImDrawData) -> tuple[int, int, int, int]:
    """Dear ImGui's clip rectangle (window units, y down) in framebuffer pixels, y up."""
    scale = data.framebuffer_scale
    left, right = (clip.x - data.display_pos.x) * scale.x, (clip.z - data.display_pos.x) * scale.x
    top, bottom = (clip.y - data.display_pos.y) * scale.y, (clip.w - data.display_pos.y) * scale.y
    height = data.display_size.y * scale.y
    return int(left), int(height - bottom), max(0, int(right - left)), max(0, int(bottom - top))
