"""Smoothing: what stands still does not tremble, what moves fast arrives at once."""

import numpy as np

from cap4d.drive.face_driver import EXPR
from cap4d.drive.one_euro import OneEuro


def smoothed(values, fps=30.0):
    smooth = OneEuro(*EXPR)
    return np.array([smooth(np.array([value]), i / fps)[0] for i, value in enumerate(values)])


def test_a_still_face_trembles_less():
    noise = np.random.default_rng(0).normal(0, 0.01, 300)
    assert smoothed(noise)[30:].std() < 0.75 * noise.std()


def test_a_blink_of_a_tenth_of_a_second_stays_one():
    blink = np.zeros(60)
    blink[30:33] = [0.6, 1.0, 0.5]
    out = smoothed(blink)
    assert out.max() > 0.93 and np.argmax(out) == 31 and out[34] < 0.1


def test_it_settles_on_what_stays():
    assert abs(smoothed(np.r_[np.zeros(10), np.ones(60)])[-1] - 1) < 1e-3


def test_time_that_stands_or_runs_back_starts_anew():
    smooth = OneEuro(1.0, 0.0)
    smooth(np.zeros(2), 1.0)
    for t in (1.0, 0.5):
        np.testing.assert_array_equal(smooth(np.ones(2), t), np.ones(2))
        smooth.reset()
        smooth(np.zeros(2), 1.0)


def test_after_a_reset_nothing_is_remembered():
    smooth = OneEuro(1.0, 0.0)
    smooth(np.zeros(1), 0.0)
    smooth.reset()
    assert smooth(np.ones(1), 0.01)[0] == 1.0
