"""Bounded least squares: the optimum's conditions hold, whatever the start."""

import numpy as np
import pytest

from cap4d.drive.bounded import solve_bounded


def problem(seed: int, n: int = 40):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(3 * n, n)) * 10 ** rng.uniform(-1, 1, n)
    low = np.where(np.arange(n) < 6, -np.inf, np.where(np.arange(n) == 7, 0.0, rng.choice([-1.0, 0.0], n)))
    high = np.where(np.arange(n) < 6, np.inf, np.where(np.arange(n) == 7, 0.0, 1.0))
    return rows.T @ rows + np.eye(n), rows.T @ rng.normal(size=3 * n) * 10, low, high, rng.normal(size=n)


@pytest.mark.parametrize("seed", range(12))
def test_no_variable_wants_to_move(seed):
    normal, right, low, high, start = problem(seed)
    x = solve_bounded(normal, right, low, high, start)
    slope = normal @ x - right
    small = 1e-6 * (1 + np.abs(right).max())
    assert ((x >= low) & (x <= high)).all()
    assert (slope[x > low] < small).all() and (slope[x < high] > -small).all()
    assert ((x == low) | (x == high)).any()  # else the bounds were not put to the test


def test_without_bounds_it_is_the_plain_solution():
    normal, right, _, _, start = problem(99)
    free = np.full(len(right), np.inf)
    x = solve_bounded(normal, right, -free, free, start)
    np.testing.assert_allclose(x, np.linalg.solve(normal, right), rtol=1e-8)


def test_the_solution_as_a_start_comes_back():
    normal, right, low, high, start = problem(3)
    x = solve_bounded(normal, right, low, high, start)
    np.testing.assert_allclose(solve_bounded(normal, right, low, high, x), x, atol=1e-9)
