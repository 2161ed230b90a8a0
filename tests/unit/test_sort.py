"""The depth sort: exact, stable, and safe with anything a float can hold."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d import _core

FORWARD = np.eye(4, dtype=np.float32)


def order(depths: np.ndarray, **options: int) -> np.ndarray:
    means = np.zeros((len(depths), 3), np.float32)
    means[:, 2] = depths
    return _core.sort_by_depth(means, FORWARD, **options)


@pytest.mark.parametrize("count", [0, 1, 2, 5000, 70_000])
def test_like_a_stable_sort(count: int) -> None:
    depths = np.random.default_rng(count).normal(1, 0.5, count).astype(np.float32)
    assert np.array_equal(order(depths), np.argsort(depths, kind="stable"))


def test_equal_depths_keep_their_order() -> None:
    depths = np.random.default_rng(0).integers(0, 7, 3000).astype(np.float32)
    assert np.array_equal(order(depths), np.argsort(depths, kind="stable"))


def test_negative_huge_and_tiny_depths() -> None:
    depths = np.array([1e38, -1e38, 1e-40, -1e-40, 3.0, -3.0, 0.0], np.float32)
    assert np.array_equal(depths[order(depths)], np.sort(depths))


def test_what_is_not_finite_comes_last() -> None:
    depths = np.array([np.nan, 2.0, np.inf, 1.0, -np.inf], np.float32)
    assert order(depths).tolist() == [3, 1, 0, 2, 4]


def test_depth_is_along_the_camera_axis() -> None:
    rng = np.random.default_rng(1)
    means, viewmat = rng.normal(size=(500, 3)).astype(np.float32), np.eye(4, dtype=np.float32)
    viewmat[2] = [0.36, 0.48, 0.8, 2.0]
    depths = means.astype(np.float64) @ viewmat[2, :3] + 2
    assert (np.diff(depths[_core.sort_by_depth(means, viewmat)]) > -1e-6).all()


def test_threads_do_not_change_it() -> None:
    depths = np.random.default_rng(2).normal(size=50_000).astype(np.float32)
    assert np.array_equal(order(depths, threads=1), order(depths, threads=5))
