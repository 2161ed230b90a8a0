"""What is shown where a stream has a gap: it holds, then eases to the neutral face; it returns smoothly."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from cap4d.drive.clip import Frame
from cap4d.drive.jitter_buffer import Moment
from cap4d.drive.sample import mix

HOLD = 0.25  # s that a gap is taken for a hiccup
EASE = 0.75  # s to the neutral face
RETURN = 0.2  # s back from it, or from the last of another clock
HICCUP = 0.05  # s of standing still after which going on would be seen as a jump

State = Literal["waiting", "playing", "holding", "easing"]


class Ease:
    """Follows the moments of a stream. Not for two threads at once.

    Args:
        neutral: What is shown before the first frame.
    Attributes:
        state: `waiting`: nothing comes, the face is neutral; `playing`; `holding` the last frame; `easing`.
        dry: s for which nothing new came.
    """

    def __init__(self, neutral: Frame) -> None:
        self.state: State = "waiting"
        self.dry = 0.0
        self._neutral = self._goal = self._start = self._shown = neutral
        self._stopped: float | None = None  # since when nothing new comes
        self._fade_end, self._fade_time = float("-inf"), RETURN

    def follow(self, moment: Moment | None, now: float) -> Frame:
        """What to show at `now`, when that is due."""
        if moment is not None:
            self._goal = moment.frame
        if moment is not None and moment.flows:
            self._flow(now)
        else:
            self._stand(now)
        self._shown = self._towards_neutral(self._fading(now))
        return self._shown

    def _flow(self, now: float) -> None:
        if self.state != "playing" and (self.state == "waiting" or self.dry > HICCUP):
            self._fade_time = RETURN if self.state == "waiting" else min(2 * self.dry, RETURN)
            self._start, self._fade_end = self._shown, now + self._fade_time
        self.state, self.dry, self._stopped = "playing", 0.0, None

    def _stand(self, now: float) -> None:
        if self.state == "waiting":
            return
        if self._stopped is None:
            self._stopped = now
        self.dry = max(now - self._stopped, 0.0)
        self.state = "holding" if self.dry <= HOLD else "easing" if self.dry < HOLD + EASE else "waiting"

    def _fading(self, now: float) -> Frame:
        left = (self._fade_end - now) / self._fade_time
        return self._goal if left <= 0 else mix(self._start, self._goal, smooth(1 - left))

    def _towards_neutral(self, frame: Frame) -> Frame:
        if self.state in ("playing", "holding"):
            return frame
        # where the head is in the sender's world has no neutral: it stays
        neutral = replace(self._neutral, t=frame.t, rot=frame.rot, tra=frame.tra)
        return neutral if self.state == "waiting" else mix(frame, neutral, smooth((self.dry - HOLD) / EASE))


def smooth(x: float) -> float:
    """0 to 1 with a slope of zero at both ends."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3 - 2 * x)
