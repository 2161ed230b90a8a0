"""One browser that watches: from where, how large, and what it has been sent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from cap4d.app.background import WHITE, Color
from cap4d.app.orbit import Orbit
from cap4d.app.serve.flow import LEVELS, Flow, Level
from cap4d.app.serve.message import Message

MIN_SIDE = 16  # px
SHARPEN_SECONDS = 0.3  # after which a picture that stands still is sent at its best


@dataclass(frozen=True)
class Shot:
    """All that a picture of one moment depends on; browsers with equal shots share it.

    Args:
        orbit: Where from; None: the camera path's place.
        size: (width, height) px.
        background: sRGB behind the avatar.
        quantiser: See `JpegEncoder.encode`.
    """

    orbit: Orbit | None
    size: tuple[int, int]
    background: Color
    quantiser: int


class Watcher:
    """State of one connection.

    Args:
        deliver: Takes a message on its way; callable from any thread, never blocks.
        area: px that a picture may have, at any shape.
    """

    def __init__(self, deliver: Callable[[bytes], None], *, area: int) -> None:
        self.deliver, self.area = deliver, area
        self.orbit: Orbit | None = None
        self.size = (math.isqrt(area),) * 2
        self.background: Color = WHITE
        self.flow = Flow()
        self.pictures = 0  # sent so far
        self._shown: tuple[object, Shot] | None = None  # (moment, shot) of the last picture
        self._moved = -math.inf  # when the last picture of something new went out

    def shot(self, moment: object, now: float) -> Shot:
        """What it should see of `moment` now: coarser on a slow line, unless it has stood for a while."""
        level = LEVELS[self.flow.level]
        if self._shown is not None and now - self._moved >= SHARPEN_SECONDS:
            still = self._shot(LEVELS[0])
            shown_moment, shown = self._shown
            if moment == shown_moment and (still.orbit, still.background) == (shown.orbit, shown.background):
                level = LEVELS[0]
        return self._shot(level)

    def wants(self, moment: object, now: float) -> bool:
        """Whether a picture of `moment` is to be sent."""
        return self.flow.ready and self._shown != (moment, self.shot(moment, now))

    def sharpens_at(self) -> float:
        """When a better picture of the same may be due."""
        return math.inf if self.flow.level == 0 else self._moved + SHARPEN_SECONDS

    def send(self, data: bytes, moment: object, shot: Shot, *, begun: float, now: float) -> None:
        """A picture goes out; its number is `pictures` before the call."""
        if self._shown is None or self._shown[0] != moment or self._shown[1].orbit != shot.orbit:
            self._moved = now
        self._shown = moment, shot
        self.flow.sent(self.pictures, begun, now)
        self.pictures += 1
        self.deliver(data)

    def look(self, message: Message, start: Callable[[], Orbit]) -> None:
        """Turns, pans, zooms, resizes.

        Args:
            start: The view to take over, the first time.
        """
        if message.size is not None:
            self.size = message.size
        if message.background is not None:
            self.background = tuple(round(255 * x) / 255 for x in message.background)
        if message.home:
            self.orbit = None
        if message.turn is None and message.pan is None and message.zoom is None:
            return
        orbit = start() if self.orbit is None else self.orbit
        orbit = orbit if message.turn is None else orbit.turned(*message.turn)
        orbit = orbit if message.pan is None else orbit.panned(*message.pan)
        self.orbit = orbit if message.zoom is None else orbit.zoomed(message.zoom)

    def _shot(self, level: Level) -> Shot:
        size = fitted_size(self.size, self.area, level.scale)
        return Shot(self.orbit, size, self.background, level.quantiser)


def fitted_size(size: tuple[int, int], area: int, scale: float = 1.0) -> tuple[int, int]:
    """The largest even size of `size`'s shape within `size` and `area` px, times `scale`."""
    shrink = scale * min(1.0, math.sqrt(area / (size[0] * size[1])))
    width, height = (max(int(side * shrink) // 2 * 2, MIN_SIDE) for side in size)
    longest = max(area // MIN_SIDE // 2 * 2, MIN_SIDE)  # of a sliver, whose other side is MIN_SIDE
    return min(width, longest), min(height, longest)
