"""How much a browser is sent: never more than it has shown, and no better than its line carries. Pure.

A picture goes out only while fewer than two are on their way; what is drawn next is always the latest. So a
slow line costs pictures, not latency. Where pictures still take long, they become coarser, then smaller.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

IN_FLIGHT = 2  # pictures on their way: one is shown while the next one travels
SLOW, FAST = 0.15, 0.08  # s from drawing to shown: coarser above, finer below
FLOOR_FACTOR, NEAR_FLOOR = 2.0, 1.2  # a line that is long by itself is slow, or fast, at these times its best
WINDOW = 0.5  # s of acknowledgements that are judged at once
ENOUGH = 4  # of them
PATIENCE, LONGEST_PATIENCE = 4.0, 60.0  # s of a fast line before finer pictures are tried
RELAPSE = 5.0  # s within which a coarser step after a finer one says that it was one too many
STALLED = 10.0  # s without an acknowledgement
KEPT = 120  # latencies kept for the median


@dataclass(frozen=True)
class Level:
    """How good pictures are: share of the full width and height, and the JPEG's quantiser."""

    scale: float
    quantiser: int


LEVELS = (Level(1, 3), Level(1, 5), Level(1, 8), Level(0.75, 8), Level(0.5, 8), Level(0.5, 14))


class Flow:
    """Of one browser. Times in seconds of one clock."""

    def __init__(self) -> None:
        self.level = 0
        self.latencies: deque[float] = deque(maxlen=KEPT)
        self._in_flight: dict[int, tuple[float, float]] = {}  # number -> (begun, sent)
        self._recent: deque[tuple[float, float]] = deque()  # (acknowledged, latency)
        self._floor = math.inf
        self._changed = self._finer = -math.inf
        self._patience = PATIENCE

    @property
    def ready(self) -> bool:
        """Whether another picture may go out."""
        return len(self._in_flight) < IN_FLIGHT

    @property
    def latency(self) -> float | None:
        """Median of late, s from the begin of drawing to the echo that it is shown; None: not known yet."""
        return float(np.median(self.latencies)) if self.latencies else None

    def sent(self, number: int, begun: float, now: float) -> None:
        """Picture `number`, whose drawing began at `begun`, goes out."""
        self._in_flight[number] = begun, now

    def stalled(self, now: float) -> bool:
        """Whether a picture has been on its way for too long."""
        return any(now - sent > STALLED for _, sent in self._in_flight.values())

    def acknowledged(self, number: int, now: float) -> float | None:
        """Picture `number` is on screen, and with it all before it; its latency. None: it is not under way,
        and this says nothing."""
        if number not in self._in_flight:
            return None
        begun, _ = self._in_flight[number]
        for other in [n for n in self._in_flight if n <= number]:
            del self._in_flight[other]
        latency = now - begun
        self.latencies.append(latency)
        self._floor = min(self._floor, latency)
        self._recent.append((now, latency))
        while self._recent[0][0] < now - WINDOW:
            self._recent.popleft()
        self._adapt(now)
        return latency

    def _adapt(self, now: float) -> None:
        since = now - self._changed
        if len(self._recent) < ENOUGH or since < WINDOW:
            return
        middle = float(np.median([latency for _, latency in self._recent]))
        if middle > max(SLOW, FLOOR_FACTOR * self._floor) and self.level < len(LEVELS) - 1:
            if now - self._finer < RELAPSE:
                self._patience = min(2 * self._patience, LONGEST_PATIENCE)
            self._change(self.level + 1, now)
        elif middle < max(FAST, NEAR_FLOOR * self._floor) and self.level > 0 and since >= self._patience:
            self._finer = now
            self._change(self.level - 1, now)

    def _change(self, level: int, now: float) -> None:
        self.level, self._changed = level, now
        self._recent.clear()
