"""What stands behind the avatar: a colour, an image, or nothing (shown as a checkerboard)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from cap4d.app.shader_source import build_program

from cap4d.errors import ArgumentError, DataError

Color = tuple[float, float, float]
"""sRGB in [0, 1]."""

WHITE: Color = (1.0, 1.0, 1.0)
MAX_PIXELS = 64 << 20  # of a file: refused before they are decoded
MAX_SIDE = 4096  # px of what is kept
# What files begin with -> FFmpeg's name for the format; nothing else is tried.
FORMATS = {
    b"\x89PNG\r\n\x1a\n": "png_pipe",
    b"\xff\xd8\xff": "jpeg_pipe",
    b"RIFF....WEBP": "webp_pipe",
    b"BM": "bmp_pipe",
}
CHECK_PX = 12  # side of the checkerboard's squares
CHECK_GREYS = 0.86, 0.98


@dataclass(frozen=True, eq=False)
class Picture:
    """An image that covers what is behind the avatar, cut where its shape differs.

    Args:
        pixels: uint8[H, W, 3] sRGB.
    """

    pixels: np.ndarray

    def __post_init__(self) -> None:
        p = self.pixels
        if p.dtype != np.uint8 or p.ndim != 3 or p.shape[2] != 3 or not p.size:
            raise ArgumentError(f"background: expected uint8[H, W, 3], got {p.dtype}{list(p.shape)}")

    @classmethod
    def load(cls, path: str | Path) -> Picture:
        """Reads a PNG, JPEG, WebP or BMP; what is transparent in it is white.

        Raises:
            ArgumentError: There is no such file.
            DataError: It is no such image, or has more than 64 megapixels.
        """
        path = Path(path)
        if not path.is_file():
            raise ArgumentError(f"background: expected an image file, got {path}")
        import av

        try:
            pixels = _decoded(path)
        except (av.FFmpegError, OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or str(error)
            raise DataError(path, "image", expected="one that can be decoded", found=found[:200]) from None
        return cls(pixels)


@dataclass(frozen=True)
class Checkerboard:
    """Stands for transparency."""


Background = Color | Picture | Checkerboard | None
"""None: nothing at all, the result keeps its alpha."""


class Backdrop:
    """Lays a premultiplied picture over a background, filling the framebuffer in use. One pass."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        constants = {"CHECK_PX": float(CHECK_PX), "CHECK_GREYS": CHECK_GREYS}
        self.program = build_program(ctx, "present", constants)
        self.program["behind"] = 1
        self.array = ctx.vertex_array(self.program, [])
        self._image: tuple[Picture, moderngl.Texture] | None = None
        self._nothing = ctx.texture((1, 1), 4, bytes(4))

    def draw(self, picture: moderngl.Texture, background: Background, *, upright: bool = False) -> None:
        """Draws both.

        Args:
            picture: Premultiplied sRGB, row 0 on top.
            background: None leaves the picture as it is, premultiplied.
            upright: For a window, whose row 0 is at the bottom; otherwise row 0 is the top row.
        """
        self.ctx.enable_only(moderngl.NOTHING)
        self.program["flip"] = (1, -1) if upright else (1, 1)
        self.program["size"] = picture.size
        self._set(background, picture.size)
        picture.use(0)
        self.array.render(moderngl.TRIANGLES, vertices=3)

    def over(self, picture: moderngl.Texture, *, upright: bool = False) -> None:
        """Lays a premultiplied picture over what the framebuffer in use holds."""
        self.program["flip"] = (1, -1) if upright else (1, 1)
        self._set(None, picture.size)
        picture.use(0)
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        self.array.render(moderngl.TRIANGLES, vertices=3)

    def _set(self, background: Background, size: tuple[int, int]) -> None:
        kinds = {type(None): 0, Checkerboard: 2, Picture: 3}
        self.program["kind"] = kinds.get(type(background), 1)
        if isinstance(background, Picture):
            texture = self._texture(background)
            self.program["cover"] = cover(texture.size, size)
            texture.use(1)
            return
        self._nothing.use(1)
        if isinstance(background, tuple | list):
            self.program["background"] = tuple(background)

    def _texture(self, picture: Picture) -> moderngl.Texture:
        if self._image is None or self._image[0] is not picture:
            height, width = picture.pixels.shape[:2]
            texture = self.ctx.texture((width, height), 3, np.ascontiguousarray(picture.pixels), alignment=1)
            texture.build_mipmaps()
            texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
            texture.repeat_x = texture.repeat_y = False
            self._image = picture, texture
        return self._image[1]


def cover(image: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """The share of an image's (width, height) that is seen where it covers `size`."""
    aspect = (size[0] * image[1]) / (size[1] * image[0])
    return min(aspect, 1.0), min(1 / aspect, 1.0)


def _decoded(path: Path) -> np.ndarray:
    """uint8[H, W, 3], upright."""
    import av

    limit = {"max_pixels": str(MAX_PIXELS)}
    with av.open(str(path), format=_format(path), options=limit) as file:
        context: Any = file.streams.video[0].codec_context if file.streams.video else None
        if context is None:
            raise DataError(path, "image", expected="one that can be decoded", found="an unknown kind")
        if not 1 <= context.width * context.height <= MAX_PIXELS:
            found = f"{context.width}x{context.height}" if context.width else "more, or none"
            raise DataError(path, "size", expected=f"at most {MAX_PIXELS} px", found=found)
        context.options = limit
        frame = next(file.decode(video=0), None)
        if frame is None:
            raise DataError(path, "image", expected="a picture", found="none")
        turns, image = frame.rotation // 90, _shrunk(frame)
    alpha = image[..., 3:].astype(np.uint16)
    on_white = image[..., :3] if alpha.min() == 255 else (image[..., :3] * alpha + 255 * (255 - alpha)) // 255
    return np.ascontiguousarray(np.rot90(on_white, turns).astype(np.uint8))


def _shrunk(frame: Any) -> np.ndarray:
    """uint8[H, W, 4], no side longer than `MAX_SIDE`: no four bytes for every pixel of a large image."""
    from av.video.reformatter import Interpolation

    scale = min(1.0, MAX_SIDE / max(frame.width, frame.height))
    width, height = (max(1, round(side * scale)) for side in (frame.width, frame.height))
    small = frame.reformat(width, height, format="rgba", interpolation=Interpolation.AREA)
    return small.to_ndarray()


def _format(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(16)
    for magic, name in FORMATS.items():
        if len(start) >= len(magic) and all(m in (ord("."), s) for m, s in zip(magic, start, strict=False)):
            return name
    raise DataError(path, "image", expected="a PNG, JPEG, WebP or BMP", found=repr(start[:8]))
