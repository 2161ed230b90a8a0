"""How long calls take: warmed up, interleaved, and summed up by their percentiles."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Wall-clock times of one call.

    Args:
        seconds: Of each run, in order.
    """

    seconds: tuple[float, ...]

    @property
    def median_ms(self) -> float:
        return percentile_ms(self.seconds, 50)

    def report(self) -> dict[str, float | int]:
        """Median, 95th and 99th percentile and least, ms, and how many runs they are of."""
        names = {"median_ms": 50, "p95_ms": 95, "p99_ms": 99, "least_ms": 0}
        times = {name: round(percentile_ms(self.seconds, q), 4) for name, q in names.items()}
        return {**times, "runs": len(self.seconds)}


def percentile_ms(seconds: tuple[float, ...], percent: float) -> float:
    """Percentile by linear interpolation between the sorted times, in milliseconds."""
    return float(np.percentile(np.asarray(seconds) * 1e3, percent))


TURN = 5  # calls in a row, before the next one's turn; the first does not count


def measure(
    calls: Mapping[str, Callable[[], object]],
    *,
    runs: int,
    rest_s: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Timing]:
    """Times several calls in turns, so that whatever else the machine does hits all alike.

    A turn is `TURN` runs of one call. The first of them finds the caches as another call left them, which is
    not what a player or a fit sees, and does not count. Each round of turns has an order of its own.

    Args:
        calls: By name.
        runs: Of each call that count.
        rest_s: Pause before each turn.
        clock: Seconds.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    shuffle, names = np.random.default_rng(0), list(calls)
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        while any(len(times) < runs for times in seconds.values()):
            for place in shuffle.permutation(len(names)):
                call, times = calls[names[place]], seconds[names[place]]
                time.sleep(rest_s)
                call()
                for _ in range(min(TURN - 1, runs - len(times))):
                    start = clock()
                    call()
                    times.append(clock() - start)
    finally:
        if was_enabled:
            gc.enable()
    return {name: Timing(tuple(times)) for name, times in seconds.items()}
