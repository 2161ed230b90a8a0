"""Pictures out of a framebuffer without waiting for the GPU: each comes with the call after its own."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture that was on screen.

    Args:
        image: uint8[H, W, 4], row 0 on top.
        t: When, as it was given.
    """

    image: np.ndarray
    t: float


class Readback:
    """Copies framebuffers into buffers of the driver's, two in turns, and those into memory a picture later.

    Args:
        ctx: The framebuffers' context.
        upright: Whether their row 0 is at the bottom, as a window's is.
    """

    def __init__(self, ctx: moderngl.Context, *, upright: bool = True) -> None:
        self.ctx, self.upright = ctx, upright
        self._buffers: list[moderngl.Buffer | None] = [None, None]
        self._pending: tuple[tuple[int, int], float] | None = None

    def push(self, framebuffer: moderngl.Framebuffer, size: tuple[int, int], t: float) -> Shown | None:
        """Begins to read a picture of (width, height) px that is shown at `t`; returns the one before."""
        self._buffers.reverse()
        length = 4 * size[0] * size[1]
        if self._buffers[0] is None or self._buffers[0].size != length:
            self._buffers[0] = self.ctx.buffer(reserve=length)
        framebuffer.read_into(self._buffers[0], viewport=(0, 0, *size), components=4, alignment=1)
        before, self._pending = self._pending, (size, t)
        return None if before is None else self._fetched(self._buffers[1], *before)

    def flush(self) -> Shown | None:
        """The last picture, if there is one that was not returned."""
        last, self._pending = self._pending, None
        return None if last is None else self._fetched(self._buffers[0], *last)

    def _fetched(self, buffer: moderngl.Buffer, size: tuple[int, int], t: float) -> Shown:
        image = np.frombuffer(buffer.read(), np.uint8).reshape(size[1], size[0], 4)
        return Shown(image[::-1] if self.upright else image, t)
