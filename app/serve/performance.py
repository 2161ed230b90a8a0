"""What the avatar does, the same for everybody who watches: a clip or a live stream, with hands on it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.clip import Clip, Frame
from cap4d.drive.expressions import expression_groups, expression_names, expression_ranges
from cap4d.drive.sample import sample

LIVE_FPS = 30.0  # pictures of a live stream a second
MAX_FPS = 60.0  # of a clip
EPSILON = 1e-6  # of a frame, for times that are a frame's but for rounding


class Stream(Protocol):
    """What is needed of `cap4d.drive.live.LiveStream`."""

    state: str
    error: Exception | None

    def frame(self, now: float) -> Frame: ...

    def shown(self, now: float) -> None: ...

    def statistics(self) -> dict[str, Any]: ...


class ClipTime:
    """A clip on the wall clock, again and again. Times in s of one clock.

    Attributes:
        state: What a live stream does; nothing of a clip.
        error: Why nothing comes any more; a clip always comes.
    """

    is_live = False
    state = ""
    error = None

    def __init__(self, clip: Clip, now: float) -> None:
        self.clip, self.fps, self.paused = clip, min(clip.fps, MAX_FPS), False
        self._start, self._stood = now, 0

    @property
    def duration(self) -> float:
        return self.clip.duration

    def number(self, now: float) -> int:
        """Of the picture due; it grows on through repetitions."""
        return self._stood if self.paused else max(int((now - self._start) * self.fps + EPSILON), 0)

    def due(self, now: float) -> float:
        """When the next one is."""
        return math.inf if self.paused else self._start + (self.number(now) + 1) / self.fps

    def position(self, now: float) -> float:
        """s in the clip."""
        return self.number(now) / self.fps % self.duration

    def frame(self, now: float) -> Frame:
        return sample(self.clip, self.number(now) / self.fps)

    def pause(self, paused: bool, now: float) -> None:
        """Pauses, or goes on from there."""
        number = self.number(now)
        self.paused, self._stood, self._start = paused, number, now - number / self.fps

    def seek(self, seconds: float, now: float) -> None:
        """To a moment of the clip."""
        number = round(min(max(seconds, 0.0), self.duration - 1 / self.fps) * self.fps)
        self._stood, self._start = number, now - number / self.fps

    def drawn(self, now: float) -> None:
        """Nothing depends on it."""

    def statistics(self) -> dict[str, Any]:
        return {}


class StreamTime:
    """A live stream; it can be frozen, not moved."""

    is_live = True
    fps, duration = LIVE_FPS, 0.0

    def __init__(self, stream: Stream) -> None:
        self.stream, self.paused = stream, False
        self._frozen: Frame | None = None
        self._stood = 0

    def number(self, now: float) -> int:
        """See `ClipTime`."""
        return self._stood if self.paused else int(now * self.fps)

    def due(self, now: float) -> float:
        """See `ClipTime`."""
        return math.inf if self.paused else (int(now * self.fps) + 1) / self.fps

    @property
    def state(self) -> str:
        """`waiting`, `playing`, `holding` or `easing`."""
        return str(self.stream.state)

    @property
    def error(self) -> Exception | None:
        """Why nothing comes any more, if so."""
        return self.stream.error

    def position(self, now: float) -> float:
        return 0.0

    def frame(self, now: float) -> Frame:
        if not self.paused or self._frozen is None:
            self._frozen = self.stream.frame(now)
        return self._frozen

    def pause(self, paused: bool, now: float) -> None:
        """Holds the frame of the moment, or goes on with the stream."""
        self._stood, self.paused = self.number(now), paused

    def seek(self, seconds: float, now: float) -> None:
        """A stream has no other moments."""

    def drawn(self, now: float) -> None:
        """The picture of the last `frame` is ready."""
        if not self.paused:
            self.stream.shown(now)

    def statistics(self) -> dict[str, Any]:
        return self.stream.statistics()


class Performance:
    """A source, and expressions that somebody holds.

    Args:
        source: `ClipTime` or `StreamTime`.
        bundle: The avatar's: names and ranges of its expressions.
    """

    def __init__(self, source: ClipTime | StreamTime, bundle: Bundle) -> None:
        self.source = source
        self.names, self.ranges = expression_names(bundle), expression_ranges(bundle)
        self.groups = expression_groups(bundle)
        self.held: dict[str, float] = {}  # expression -> its value
        self.edits = 0
        self._index = {name: i for i, name in enumerate(self.names)}

    def number(self, now: float) -> tuple[int, int]:
        """Changes when there is something new to show."""
        return self.source.number(now), self.edits

    def frame(self, now: float) -> Frame:
        """The frame of the moment, with what is held."""
        frame = self.source.frame(now)
        if not self.held:
            return frame
        expr = np.array(frame.expr, np.float32)
        for name, value in self.held.items():
            expr[self._index[name]] = value
        return replace(frame, expr=expr)

    def hold(self, name: str, value: float | None) -> None:
        """Holds an expression within its range; None lets it go. Names of other rigs are passed over."""
        if name not in self._index:
            return
        self.edits += 1
        if value is None:
            self.held.pop(name, None)
        else:
            self.held[name] = float(np.clip(value, *self.ranges[self._index[name]]))

    def release(self) -> None:
        """Lets all expressions go."""
        self.held.clear()
        self.edits += 1
