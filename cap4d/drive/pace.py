"""Holds back a sender who runs ahead of its own stamps: a file poured into a pipe plays at its own speed."""

from __future__ import annotations

FASTER = 1.002  # than the stamps; no clock drifts so much, so a live sender is never held back for it
MAX_STEP = 0.25  # s between two stamps that may be waited for; a longer one is a cut
MAX_BEHIND = 2.0  # s that a sender who was stopped may catch up at once
LEAST = 5e-3  # s worth waiting


class Pace:
    """How far a sender is ahead of its stamps, since its first frame."""

    def __init__(self) -> None:
        self._lead = 0.0
        self._last: tuple[float, float] | None = None

    def lead(self, t: float, now: float) -> float:
        """s to wait before the frame after the one stamped `t`, which came at `now`; 0 for none."""
        if self._last is not None:
            stamps, elapsed = min(max(t - self._last[0], 0.0), MAX_STEP), max(now - self._last[1], 0.0)
            self._lead = max(self._lead + stamps - FASTER * elapsed, -MAX_BEHIND)
        self._last = t, now
        return self._lead if self._lead > LEAST else 0.0
