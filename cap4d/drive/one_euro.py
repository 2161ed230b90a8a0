"""Smoothing that lets go when something moves: still faces do not tremble, and blinks stay blinks."""

from __future__ import annotations

import numpy as np


class OneEuro:
    """The 1 euro filter on a vector: Casiez, Roussel and Vogel, CHI 2012.

    A low-pass filter whose cut-off rises with the speed of the signal, each number for itself.

    Args:
        cutoff: Hz, of what stands still.
        beta: Hz more per unit and second of speed.
        speed_cutoff: Hz, of the filter on the speed.
    """

    def __init__(self, cutoff: float, beta: float, speed_cutoff: float = 1.0) -> None:
        self.cutoff, self.beta, self.speed_cutoff = cutoff, beta, speed_cutoff
        self._t, self._value, self._speed = 0.0, None, 0.0

    def __call__(self, value: np.ndarray, t: float) -> np.ndarray:
        """The smoothed value at `t` s; a time that does not advance starts anew."""
        dt = t - self._t
        if self._value is None or dt <= 0:
            self._t, self._value, self._speed = t, value.copy(), np.zeros_like(value)
            return value
        speed = (value - self._value) / dt
        self._speed = self._speed + _share(self.speed_cutoff, dt) * (speed - self._speed)
        share = _share(self.cutoff + self.beta * np.abs(self._speed), dt)
        self._t, self._value = t, self._value + share * (value - self._value)
        return self._value.copy()

    def reset(self) -> None:
        """What comes next owes nothing to what was."""
        self._value = None


def _share(cutoff, dt: float):
    """Of the new value, for a first-order low pass."""
    turns = 2 * np.pi * cutoff * dt
    return turns / (turns + 1)
