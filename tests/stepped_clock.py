"""A clock for tests that do not wait."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class SteppedClock:
    """Seconds that go on only when told to: add to `now`."""

    now: float = 100.0

    def __call__(self) -> float:
        return self.now
