"""How long frames are on their way: what decides when a live stream's moments are played.

A frame with stamp `t` that arrives at `a` has the transit `a - t`: the network's delay, plus a constant
nobody knows, the difference of two clocks. Playing moment `t` at `t + offset` shows every frame whose transit
is at most `offset`. The offset aimed at is the 98th percentile of the recent transits, plus the time between
two frames, so that there is a frame on each side to interpolate between: the percentile rule of Moon, Kurose
and Towsley 1998 ("Packet audio playout delay adjustment"). As it is a percentile of `a - t`
itself, no clock needs estimating: a drifting sender moves the window, and the offset with it. Frames that
were held up and let go together count once, as the one event they are: one stall leaves no delay behind.
"""

from __future__ import annotations

import numpy as np

WINDOW = 512  # frames
MAX_AGE = 10.0  # s
PERCENTILE = 0.98
MARGIN = 2e-3  # s, for a player that wakes late
START, SETTLED = 20e-3, 64  # s more than the first frames ask for, less and less until there are so many
RFC_GAIN = 1 / 16  # RFC 3550, 6.4.1
DEFAULT_INTERVAL = 1 / 30  # s, before there are frames enough to tell
MIN_INTERVAL, MAX_INTERVAL = 1 / 240, 1 / 5
MAX_SPREAD = 0.5  # s; who waits longer for the latest is no longer live
BURST = 0.25  # of the interval; what comes closer together was held up together
MIN_JUMP, JUMP_SPREADS = 0.25, 3.0  # s; and in times the spread of the transits


class Transit:
    """The transits of the last 10 s, 512 at most.

    Attributes:
        jitter: s, the smoothed difference of neighbours' transits (RFC 3550, 6.4.1).
        interval: s between frames, by their stamps.
        target: s, the offset aimed at.
        median: s, of the transits.
    """

    def __init__(self) -> None:
        self._t, self._arrival = np.zeros(WINDOW), np.zeros(WINDOW)
        self.clear()

    def clear(self) -> None:
        """Forgets everything: another clock."""
        self._count = 0
        self.jitter, self.interval = 0.0, DEFAULT_INTERVAL
        self.target = self.median = self._spread = 0.0

    def __len__(self) -> int:
        return min(self._count, WINDOW)

    def add(self, t: float, arrival: float) -> None:
        """One more frame, both times in s."""
        if self._count:
            last = (self._count - 1) % WINDOW
            step = abs((arrival - t) - (self._arrival[last] - self._t[last]))
            self.jitter += RFC_GAIN * (step - self.jitter)
        if self._is_burst(arrival):
            return
        at = self._count % WINDOW
        self._t[at], self._arrival[at] = t, arrival
        self._count += 1
        if self._count < SETTLED or self._count % 8 == 0:
            self._measure(arrival)

    def is_stale(self, now: float) -> bool:
        """Whether nothing, or nothing recent, is known."""
        return not self._count or now - self._arrival[(self._count - 1) % WINDOW] > MAX_AGE

    def fits(self, t: float, arrival: float) -> bool:
        """Whether the frame can be one of this clock, rather than one from after a jump of it."""
        jump = max(MIN_JUMP, JUMP_SPREADS * self._spread)
        return abs(arrival - t - self.median) <= jump

    def _is_burst(self, arrival: float) -> bool:
        """Whether the frame came right behind the last, which waited for longer."""
        last = self._arrival[(self._count - 1) % WINDOW]
        return self._count >= 8 and arrival - last < BURST * self.interval

    def _measure(self, now: float) -> None:
        recent = self._arrival[: len(self)] >= now - MAX_AGE
        t, transit = self._t[: len(self)][recent], (self._arrival - self._t)[: len(self)][recent]
        transit.sort()
        late = float(transit[min(int(np.ceil(PERCENTILE * len(transit))), len(transit)) - 1])
        self.median = float(transit[len(transit) // 2])
        self._spread = min(late - self.median, MAX_SPREAD)
        steps = np.diff(np.unique(t))
        if len(steps) >= 3:
            self.interval = float(np.clip(np.median(steps), MIN_INTERVAL, MAX_INTERVAL))
        unsettled = START * max(0.0, 1 - self._count / SETTLED)
        self.target = self.median + self._spread + self.interval + MARGIN + unsettled
