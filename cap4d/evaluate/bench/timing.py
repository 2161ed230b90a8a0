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


def measure(
    calls: Mapping[str, Callable[[], object]],
    *,
    runs: int,
    warm_up: int = 2,
    rest_s: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Timing]:
    """Times several calls, one run of each in turn, so that whatever else the machine does hits all alike.

    Each round has an order of its own: what a call leaves in the caches helps or hurts all others alike.

    Args:
        calls: By name.
        runs: Of each call that count.
        warm_up: Runs of each call before that.
        rest_s: Pause before each run.
        clock: Seconds.
    """
    for call in calls.values():
        for _ in range(warm_up):
            call()
    shuffle, names = np.random.default_rng(0), list(calls)
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        for _ in range(runs):
            for name in shuffle.permutation(names):
                call = calls[name]
                time.sleep(rest_s)
                start = clock()
                call()
                seconds[name].append(clock() - start)
    finally:
        if was_enabled:
            gc.enable()
    return {name: Timing(tuple(times)) for name, times in seconds.items()}
