"""Small least squares whose variables have bounds."""

from __future__ import annotations

import numpy as np

MAX_STEPS = 12  # more are hardly ever taken: a step frees or fixes many variables at once
SLACK = 1e-9


def solve_bounded(
    normal: np.ndarray, right: np.ndarray, low: np.ndarray, high: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """The x between `low` and `high` with the least x^T A x / 2 - b^T x, by projected Newton steps.

    Bertsekas, Projected Newton methods for optimization problems with simple constraints, 1982: variables
    that stand at a bound and are pushed against it rest, the others take Newton's step, cut at their bounds.

    Args:
        normal: float[N, N], A, positive definite.
        right, low, high: float[N]; bounds may be infinite.
        start: float[N] a guess.
    Returns:
        float[N]
    """
    x = np.clip(start, low, high)
    value = _value(normal, right, x)
    for _ in range(MAX_STEPS):
        slope = normal @ x - right
        free = ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))
        if not free.any() or np.abs(slope[free]).max() <= SLACK * (1 + np.abs(right).max()):
            break
        rows = np.flatnonzero(free)
        step = np.zeros_like(x)
        step[rows] = np.linalg.solve(normal[np.ix_(rows, rows)], slope[rows])
        x, gain = _cut_step(normal, right, x, step, low, high, value)
        if gain <= SLACK * (1 + abs(value)):
            break
        value -= gain
    return x


def _cut_step(normal, right, x, step, low, high, value) -> tuple[np.ndarray, float]:
    """The longest of the halved steps that gains something, and what it gains."""
    for halvings in range(6):
        moved = np.clip(x - 0.5**halvings * step, low, high)
        gain = value - _value(normal, right, moved)
        if gain > 0:
            return moved, gain
    return x, 0.0


def _value(normal: np.ndarray, right: np.ndarray, x: np.ndarray) -> float:
    return float(x @ (0.5 * (normal @ x) - right))
