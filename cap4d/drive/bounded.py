"""Small least squares whose variables have bounds."""

from __future__ import annotations

import numpy as np

MAX_SOLVES = 60  # of linear systems; from a good guess it takes two to ten
SLACK = 1e-9


def solve_bounded(
    normal: np.ndarray, right: np.ndarray, low: np.ndarray, high: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """The x between `low` and `high` with the least x^T A x / 2 - b^T x.

    An active set (Stark and Parker, Bounded-variable least squares, 1995, on normal equations): the free
    variables go towards their common optimum until some meet their bounds and stay there; at the optimum
    those are freed that want to leave their bounds, all at once while that helps, then one by one.

    Args:
        normal: float[N, N], A, positive definite.
        right, low, high: float[N]; bounds may be infinite.
        start: float[N] a guess.
    Returns:
        float[N]
    """
    x = np.clip(start, low, high)
    free = (x > low) & (x < high)
    enough = SLACK * (1 + np.abs(right).max())
    moved, all_at_once = True, True
    for _ in range(MAX_SOLVES):
        slope = normal @ x - right
        if not free.any() or np.abs(slope[free]).max() <= enough:
            push = np.where(x <= low, -slope, np.where(x >= high, slope, 0)) * ~free
            push[low == high] = 0
            if push.max() <= enough:
                break
            all_at_once &= moved
            free |= push > enough if all_at_once else push == push.max()
            moved = False
        share = _advance(normal, slope, x, free, low, high)
        moved |= share > 0
    return x


def _advance(normal, slope, x, free, low, high) -> float:
    """Moves `x` towards the optimum of its free variables up to the first bound; unfrees what is met.

    Returns the share of the way it went.
    """
    rows = np.flatnonzero(free)
    step = -np.linalg.solve(normal[np.ix_(rows, rows)], slope[rows])
    room = np.where(step < 0, low[rows], high[rows]) - x[rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(step != 0, room / step, np.inf)
    share = min(1.0, float(shares.min()))
    met = shares <= share
    x[rows] += share * step
    x[rows[met]] = np.where(step < 0, low[rows], high[rows])[met]
    free[rows[met & (share < 1)]] = False
    return share
