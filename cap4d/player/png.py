"""PNG pictures in memory and on disk without an image library (the capture side has OpenImageIO)."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from cap4d.atomic import replacing
from cap4d.errors import ArgumentError

COLOUR_TYPES = {3: 2, 4: 6}  # channels -> PNG colour type, RGB and RGBA
LEVEL = 4  # of deflate: smaller is faster, 6 saves two per cent
FILTER_UP = 2


def encode_png(image: np.ndarray) -> bytes:
    """uint8[H, W, 3 | 4] sRGB (with straight alpha) -> the bytes of a PNG file.

    Every row is stored as its difference from the row above (filter `Up`), which suits renders.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in COLOUR_TYPES or not image.size:
        raise ArgumentError(f"image: expected uint8[H, W, 3 or 4], got {image.dtype}{list(image.shape)}")
    height, width, channels = image.shape
    rows = image.reshape(height, width * channels)
    filtered = np.empty((height, 1 + width * channels), np.uint8)
    filtered[:, 0] = FILTER_UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, 8, COLOUR_TYPES[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"sRGB", b"\0"), (b"IDAT", zlib.compress(filtered, LEVEL)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks)


def write_png(path: Path, image: np.ndarray) -> None:
    """Writes a PNG through a temporary file."""
    data = encode_png(image)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
