"""How alike two images are: PSNR and SSIM. Images are [H, W, 3] arrays in [0, 1]."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def mse(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean squared error over all pixels and channels, in float64."""
    difference = np.asarray(image, np.float64) - np.asarray(truth, np.float64)
    return float(np.square(difference).mean())


def psnr_of_mse(error: float) -> float:
    """Peak signal-to-noise ratio, dB, of a mean squared error at peak 1; infinite at zero."""
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio of one image, dB."""
    return psnr_of_mse(mse(image, truth))


def pooled_psnr(errors: np.ndarray) -> float:
    """PSNR, dB, of the squared error pooled over all pixels of images of one size, given each one's `mse`.

    One bad image weighs as much as its error, unlike in the mean of the images' PSNRs.
    """
    return psnr_of_mse(float(np.mean(errors)))


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean structural similarity, Wang et al. 2004, eq. 13: Gaussian window 11x11 of sigma 1.5, only where it
    fits.

    The mean over the colour channels of the images' mean SSIM, in float64.
    """
    x, y = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    mean_x, mean_y = _blur(x), _blur(y)
    var_x, var_y = _blur(x * x) - mean_x**2, _blur(y * y) - mean_y**2
    cov = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    return float((luminance * (2 * cov + SSIM_C2) / (var_x + var_y + SSIM_C2)).mean())


def _blur(image: np.ndarray) -> np.ndarray:
    x = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()
    rows = sliding_window_view(image, SSIM_WINDOW, axis=0) @ window
    return sliding_window_view(rows, SSIM_WINDOW, axis=1) @ window
