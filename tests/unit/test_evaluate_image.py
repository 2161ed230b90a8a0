"""PSNR and SSIM on images whose answers are known."""

import math

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from cap4d.evaluate.image import mse, pooled_psnr, psnr, ssim


def test_psnr_of_a_known_error():
    truth = np.full((8, 8, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert psnr(truth, truth) == math.inf


def test_pooling_weighs_errors_and_not_decibels():
    errors = np.array([1e-2, 1e-4])
    assert pooled_psnr(errors) == pytest.approx(-10 * math.log10(5.05e-3))
    assert pooled_psnr(errors) < (20 + 40) / 2


def test_ssim_is_one_for_equal_and_known_for_flat_images():
    image = np.random.default_rng(0).random((16, 16, 3))
    assert ssim(image, image) == pytest.approx(1.0)
    a, b = np.full((16, 16, 3), 0.2), np.full((16, 16, 3), 0.6)
    assert ssim(a, b) == pytest.approx((2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4))


@pytest.mark.parametrize("shape", [(11, 11, 3), (12, 43, 3), (75, 42, 1), (107, 64, 3)])
def test_ssim_is_that_of_every_window(shape):
    rng = np.random.default_rng(2)
    image, truth = rng.random(shape), rng.random(shape)
    x = np.arange(-5, 6)
    weights = np.exp(-(x[:, None] ** 2 + x**2) / (2 * 1.5**2))
    weights /= weights.sum()
    a, b = (sliding_window_view(each, (11, 11), axis=(0, 1)) for each in (image, truth))
    mean = lambda windows: np.einsum("...ij,ij", windows, weights)  # noqa: E731
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, cov = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    values = (2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)
    values /= (mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)
    assert ssim(image, truth) == pytest.approx(values.mean(), abs=1e-12)


def test_ssim_falls_with_noise():
    rng = np.random.default_rng(1)
    image = rng.random((32, 32, 3))
    noise = rng.standard_normal(image.shape)
    values = [ssim(image + s * noise, image) for s in (0.01, 0.1, 0.5)]
    assert values == sorted(values, reverse=True)
    assert mse(image + 0.1 * noise, image) == pytest.approx(0.01, rel=0.1)
