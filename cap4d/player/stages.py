"""How long each stage of a frame takes."""

from __future__ import annotations

import sys
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

KEPT = 10_000  # samples per stage; older ones are forgotten


class Stages:
    """Wall-clock times per named stage.

    >>> stages = Stages()
    >>> with stages.time("rig"):
    ...     pass
    >>> sorted(stages.report()["rig"])
    ['median_ms', 'p95_ms', 'p99_ms']
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=KEPT))

    @contextmanager
    def time(self, stage: str) -> Iterator[None]:
        """Measures the body as one sample of `stage`."""
        start = time.perf_counter()
        yield
        self.seconds[stage].append(time.perf_counter() - start)

    def add(self, stage: str, seconds: float) -> None:
        """One sample that was measured elsewhere."""
        self.seconds[stage].append(seconds)

    def clear(self) -> None:
        """Forgets everything, e.g. after warming up."""
        self.seconds.clear()

    def report(self) -> dict[str, dict[str, float]]:
        """For each stage, in the order first seen: median, 95th and 99th percentile, ms."""
        return {stage: _percentiles(values) for stage, values in self.seconds.items() if values}


def _percentiles(seconds: deque[float]) -> dict[str, float]:
    median, p95, p99 = np.percentile(np.array(seconds) * 1e3, [50, 95, 99])
    return {name: round(float(v), 3) for name, v in (("median_ms", median), ("p95_ms", p95), ("p99_ms", p99))}


def peak_memory_mb() -> float:
    """The most memory this process has held, MB (0 where the system does not say)."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6
