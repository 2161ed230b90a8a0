"""The numbers of a fit stay numbers."""

import json

import numpy as np

from cap4d.avatar.report import LEAST_MSE, Comparison


def comparison(errors: list[float], pixels: list[int]) -> Comparison:
    each = np.maximum(np.array(errors), LEAST_MSE)
    none = [np.zeros((1, 1, 3), np.float32)] * len(errors)
    same = {name: each for name in ("ours", "nearest", "time")}
    tail = np.zeros(len(errors), bool)
    return Comparison(none, none, none, same, np.array(pixels, float), np.ones(len(errors)), tail)


def test_a_repeated_frame_counts_as_100_db_and_can_be_written():
    summary = comparison([0.02, 0.0], [1, 1]).summary(np.ones(2, bool))
    assert summary["nearest_frame_psnr_mean"] < 100
    json.dumps(summary, allow_nan=False)


def test_pixels_are_pooled_not_frames():
    summary = comparison([0.01, 0.05], [300, 100]).summary(np.ones(2, bool))
    np.testing.assert_allclose(summary["held_out_psnr"], -10 * np.log10((300 * 0.01 + 100 * 0.05) / 400))
