"""Checks that bytes are a PNG of sane size, without decoding it: no decoder sees a preview unasked."""

from __future__ import annotations

import struct

from cap4d.errors import DataError

MAX_SIDE = 4096
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def check_png(data: bytes, *, source: str) -> tuple[int, int]:
    """Width and height, px.

    Raises:
        DataError: Not a PNG, or larger than 4096 px a side.
    """
    if data[:8] != SIGNATURE or data[12:16] != b"IHDR" or len(data) < 33:
        raise DataError(source, "signature", expected="a PNG file", found=repr(bytes(data[:16])))
    width, height = struct.unpack(">II", data[16:24])
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DataError(source, "size", expected=f"1 to {MAX_SIDE} px a side", found=f"{width}x{height}")
    return width, height
