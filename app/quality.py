"""How many pixels the CPU renderer is asked for: the user's choice, or as many as keep up."""

from __future__ import annotations

from collections import deque

CHOICES = (1.0, 0.75, 0.5, 0.35)
SMALLEST = 0.3
WINDOW = 12  # pictures between changes
TOO_SLOW, IDLE = 0.95, 0.55  # of the time there is for a picture


class Quality:
    """The picture's size as a share of the window's, each side.

    Args:
        fixed: The share the user wants; None lets `scale` follow the time that pictures take.
    """

    def __init__(self, fixed: float | None = None) -> None:
        self.fixed = fixed
        self._automatic = 1.0
        self._seconds: deque[float] = deque(maxlen=WINDOW)

    @property
    def scale(self) -> float:
        """The share that holds now."""
        return self._automatic if self.fixed is None else self.fixed

    def choose(self, fixed: float | None) -> None:
        """The user chooses a share, or None for an automatic one."""
        self.fixed = fixed
        self._seconds.clear()

    def picture_took(self, seconds: float, budget: float) -> None:
        """A picture took `seconds`, of `budget` that there are between two.

        Only the middle one of `WINDOW` pictures counts, so that one that was held up changes nothing.
        """
        self._seconds.append(seconds)
        if self.fixed is not None or len(self._seconds) < WINDOW:
            return
        load = sorted(self._seconds)[WINDOW // 2] / budget
        if load > TOO_SLOW:
            self._change(max(self._automatic * 0.85, SMALLEST))
        elif load < IDLE and self._automatic < 1:
            self._change(min(self._automatic / 0.9, 1.0))

    def _change(self, scale: float) -> None:
        self._automatic = scale
        self._seconds.clear()
