"""What the avatar does, the same for everybody who watches: a clip or a live stream, with hands on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from cap4d.app.overrides import Overrides
from cap4d.app.playback import ClipPlayback, StreamPlayback

from cap4d.bundle.bundle import Bundle
from cap4d.drive.clip import Frame
from cap4d.drive.expressions import expression_groups, expression_names, expression_ranges

MAX_FPS = 66.0  # of a clip; a little above 60, so that its frames need not come to the microsecond


class Performance:
    """A source, and expressions that somebody holds. Times in s of `time.monotonic`.

    Args:
        playback: The source.
        bundle: The avatar's: names and ranges of its expressions.
    """

    def __init__(self, playback: ClipPlayback | StreamPlayback, bundle: Bundle) -> None:
        self.playback, self.is_live = playback, playback.is_live
        self.names, self.ranges = expression_names(bundle), expression_ranges(bundle)
        self.groups = expression_groups(bundle)
        self.overrides = Overrides(self.ranges)
        self._index = {name: i for i, name in enumerate(self.names)}
        self._interval = playback.interval if self.is_live else 1 / MAX_FPS
        self._frozen = False  # a live stream, by somebody's wish
        self._number, self._look = 0, -math.inf  # of the picture due, and when to look for another

    @property
    def paused(self) -> bool:
        return self._frozen if self.is_live else self.playback.is_paused

    @property
    def duration(self) -> float:
        """s of the clip; 0: a live stream."""
        return 0.0 if self.is_live else self.playback.clip.duration

    @property
    def position(self) -> float:
        """s in the clip."""
        return 0.0 if self.is_live else self.playback.position

    @property
    def state(self) -> str:
        """What a live stream does; nothing of a clip."""
        return self.playback.state if self.is_live else ""

    @property
    def error(self) -> Exception | None:
        """Why nothing comes any more, if so."""
        return self.playback.error if self.is_live else None

    @property
    def held(self) -> dict[str, float]:
        """expression -> the value that it is held at"""
        values = self.overrides.values
        return {self.names[i]: float(values[i]) for i in np.flatnonzero(self.overrides.held)}

    def number(self, now: float) -> tuple[int, int]:
        """Changes when there is something new to show."""
        if now >= self._look and not self._frozen:
            before, self._number = self._number, self.playback.number(now)
            if self.is_live or before != self._number:
                self._look = max(self._look + self._interval, now)
        return self._number, self.overrides.version

    def due(self) -> float:
        """When something new may be there by itself."""
        return math.inf if self.paused else max(self.playback.due(), self._look)

    def frame(self) -> Frame:
        """The frame that `number` last spoke of, with what is held."""
        return self.overrides.apply(self.playback.frame())

    def drawn(self, now: float) -> None:
        """The picture of the last `frame` is ready."""
        if not self._frozen:
            self.playback.shown(now)

    def pause(self, paused: bool, now: float) -> None:
        """Stands still, or goes on: a clip from there, a stream with what comes."""
        if self.is_live:
            self.number(now)  # there is a frame to hold
            self._frozen = paused
        elif paused != self.playback.is_paused:
            self.playback.toggle(now)

    def seek(self, seconds: float, now: float) -> None:
        """To a moment of a clip; a stream has no other."""
        if not self.is_live:
            self.playback.seek(seconds, now)
            self._look = -math.inf

    def hold(self, name: str, value: float | None) -> None:
        """Holds an expression within its range; None lets it go. Names of other rigs are passed over."""
        if name not in self._index:
            return
        if value is None:
            self.overrides.let_go(self._index[name])
        else:
            self.overrides.hold(self._index[name], value)

    def statistics(self) -> Mapping[str, Any]:
        """Of a live stream."""
        return self.playback.statistics()
