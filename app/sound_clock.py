"""Where a sound is heard right now, from the moments at which the device asks for more of it.

A device takes samples in gulps, and they are heard a little later. Between gulps time goes on with the
machine's clock; the device's own, never quite as fast, is followed by a share of each gulp's difference.
Pure: callers pass times.
"""

from __future__ import annotations

FOLLOW = (
    0.1  # of a difference, with each gulp: jitter of gulps is smoothed, 100 ppm of drift stays below 1 ms
)
JUMP_SECONDS = 0.15  # a larger difference is no drift: the device was held up


class SoundClock:
    """Seconds of sound heard since `restart`, which never go back.

    Args:
        latency: s from handing samples over to hearing them.
    """

    def __init__(self, latency: float) -> None:
        self.latency = latency
        self.restart()

    def restart(self) -> None:
        """The sound starts anew; nothing of it is heard yet."""
        self._offset: float | None = None  # now + offset is what is heard
        self._heard = 0.0

    def gulp(self, handed: float, now: float) -> None:
        """The device asks for more after it took `handed` seconds of sound."""
        measured = handed - self.latency - now
        if self._offset is None or abs(measured - self._offset) > JUMP_SECONDS:
            self._offset = measured
        else:
            self._offset += FOLLOW * (measured - self._offset)

    def heard(self, now: float) -> float:
        """s; 0 before the first gulp is heard."""
        if self._offset is not None:
            self._heard = max(self._heard, now + self._offset)
        return self._heard
