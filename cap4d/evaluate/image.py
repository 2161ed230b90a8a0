"""How alike two images are: PSNR and SSIM. Images are [H, W, 3] arrays in [0, 1]."""

from __future__ import annotations

import numpy as np

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
BLOCK = 32  # rows that are blurred at once


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
    x, y = (np.array(np.moveaxis(each, -1, 0), np.float64, order="C") for each in (image, truth))
    mean_x, mean_y, square_x, square_y, product = map(_blur, (x, y, x * x, y * y, x * y))
    var_x, var_y, cov = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    return float((luminance * (2 * cov + SSIM_C2) / (var_x + var_y + SSIM_C2)).mean())


def _blur(planes: np.ndarray) -> np.ndarray:
    """[C, H, W] -> [C, H - 10, W - 10]."""
    columns = _blur_columns(planes)
    return _blur_columns(columns.swapaxes(1, 2)).swapaxes(1, 2)


def _blur_columns(planes: np.ndarray) -> np.ndarray:
    """[C, H, W] -> [C, H - 10, W], by blocks of rows: matrix products, twice as quick as one per window."""
    band = _band()
    channels, height, width = planes.shape
    out = np.empty((channels, height - SSIM_WINDOW + 1, width))
    for at in range(0, out.shape[1], BLOCK):
        rows = min(BLOCK, out.shape[1] - at)
        reach = rows + SSIM_WINDOW - 1
        np.matmul(band[:rows, :reach], planes[:, at : at + reach], out=out[:, at : at + rows])
    return out


def _band() -> np.ndarray:
    """[BLOCK, BLOCK + 10]: the window, one place further in each row."""
    x = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()
    band = np.zeros((BLOCK, BLOCK + SSIM_WINDOW - 1))
    for row in range(BLOCK):
        band[row, row : row + SSIM_WINDOW] = window
    return band
