"""What a live stream counts: frames by what became of them, and how old the pictures are. Constant memory."""

from __future__ import annotations

import math
import threading
from collections import Counter

import numpy as np

from cap4d.drive.packet import Cause

LOWEST, HIGHEST = 1e-4, 100.0  # s, of a histogram
PER_DECADE = 100  # bins; each is 2.3 % wide


class Counts:
    """How many frames came, and how many were refused for which cause. Any thread may count."""

    def __init__(self) -> None:
        self.received = 0  # whole frames, sound or not
        self.rejected: Counter[Cause] = Counter()
        self._lock = threading.Lock()

    def receive(self) -> None:
        """A frame came that could be read."""
        with self._lock:
            self.received += 1

    def reject(self, cause: Cause, *, received: bool = False, times: int = 1) -> None:
        """A frame is refused, or so many; one that was `received` already is not counted again."""
        with self._lock:
            self.received += 0 if received else times
            self.rejected[cause] += times

    def by_cause(self) -> dict[str, int]:
        """`{"syntax": 3, ...}`, causes that came up, in the order of `Cause`."""
        with self._lock:
            return {str(cause): self.rejected[cause] for cause in Cause if self.rejected[cause]}


class Histogram:
    """Durations of any number in a few hundred bins: percentiles are right to 2.3 %."""

    def __init__(self) -> None:
        decades = math.log10(HIGHEST / LOWEST)
        self._bins = np.zeros(round(decades * PER_DECADE) + 1, np.int64)

    def add(self, seconds: float) -> None:
        """One more; what is outside 0.1 ms to 100 s counts as the nearer end."""
        position = math.log10(max(seconds, LOWEST) / LOWEST) * PER_DECADE
        self._bins[min(int(position), len(self._bins) - 1)] += 1

    def __len__(self) -> int:
        return int(self._bins.sum())

    def percentile(self, percent: float) -> float:
        """s, the middle of its bin; 0 where there is none yet."""
        total = len(self)
        if not total:
            return 0.0
        index = int(np.searchsorted(self._bins.cumsum(), percent / 100 * total))
        return float(LOWEST * 10 ** ((index + 0.5) / PER_DECADE))
