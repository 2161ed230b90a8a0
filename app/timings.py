"""How long recent pictures took, stage by stage, and how many a second there are."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from cap4d.player.stages import Stages

STAGES = ("rig", "deform", "bind", "sort", "splat", "gui")
CPU_SPLAT_HOLDS_SORT = ("cpu",)  # backends whose `splat` has the sorting in it
HISTORY = 120  # pictures in the graph
RECENT = 30  # pictures that a number stands for
FPS_SECONDS = 2.0
CHANGE_SECONDS = 0.5  # between changes of the numbers shown, so that they can be read


class Timings:
    """The graph's memory: one row of milliseconds a picture."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, ...]] = deque(maxlen=HISTORY)
        self._shown: deque[float] = deque(maxlen=600)
        self._written = -np.inf
        self._numbers: dict[str, float] = {}
        self._fps = 0.0

    def picture(self, stages: Stages, backend: str, now: float) -> None:
        """A picture was shown at `now`; its times are the last ones of `stages`."""
        last = {name: _last(stages.seconds.get(name)) for name in STAGES}
        if backend in CPU_SPLAT_HOLDS_SORT:
            last["splat"] = max(last["splat"] - last["sort"], 0.0)
        self._rows.append(tuple(1e3 * last[name] for name in STAGES))
        self._shown.append(now)
        if now - self._written > CHANGE_SECONDS:
            self._write(now)

    def rows(self) -> np.ndarray:
        """float[P, len(STAGES)] ms of the last `HISTORY` pictures, the newest last."""
        return np.array(self._rows, float).reshape(-1, len(STAGES))

    def fps(self) -> float:
        """Pictures per second of the last two seconds; changes twice a second."""
        return self._fps

    def milliseconds(self) -> dict[str, float]:
        """Stage -> what it takes lately; stages that take nothing are left out."""
        return self._numbers

    def pictures_per_second(self, now: float) -> float:
        """As `fps`, at this very moment."""
        recent = [t for t in self._shown if t > now - FPS_SECONDS]
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    def _write(self, now: float) -> None:
        self._written = now
        self._fps = self.pictures_per_second(now)
        medians = np.median(self.rows()[-RECENT:], 0)
        self._numbers = {name: float(ms) for name, ms in zip(STAGES, medians, strict=True) if ms > 0}


def _last(seconds: Iterable[float] | None) -> float:
    return seconds[-1] if seconds else 0.0
