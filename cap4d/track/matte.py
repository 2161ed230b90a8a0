"""From a coarse segmentation to a matte whose edge follows the image: hair against its background."""

from __future__ import annotations

import cv2
import numpy as np

RADIUS = 1 / 40  # of the image's larger side: how far from the coarse edge hair may reach
EPSILON = 1e-4  # variance of colour (sRGB^2) below which the image has no say


def refine_matte(image: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """A guided filter of the coarse matte by the colour image, twice, then a contrast curve.

    He, Sun, Tang 2013, eq. 19-21 (colour guide).
    Args:
        image: uint8[H, W, 3].
        coarse: float32[H, W] in [0, 1].
    Returns:
        float32[H, W] in [0, 1].
    """
    guide = image.astype(np.float32) / 255
    radius = max(2, round(RADIUS * max(image.shape[:2])))
    alpha = coarse
    for r in (radius, max(1, radius // 3)):
        alpha = np.clip(guided_filter(guide, alpha, r, EPSILON), 0, 1)
    return smoothstep(alpha, 0.08, 0.92)


def guided_filter(guide: np.ndarray, values: np.ndarray, radius: int, epsilon: float) -> np.ndarray:
    """The locally linear function of the guide's colours that is nearest to `values`, averaged over windows.

    Where windows are large, the functions are found on a coarser grid (He, Sun 2015, "Fast guided filter").
    Args:
        guide: float32[H, W, 3].
        values: float32[H, W].
        radius: Half the window's side, px.
        epsilon: Ridge on the colour coefficients, colour variance.
    """
    height, width = values.shape
    step = max(1, radius // 4)
    size = (max(1, width // step), max(1, height // step))
    small, level = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (guide, values))
    window = (2 * (radius // step) + 1,) * 2

    def mean(x: np.ndarray) -> np.ndarray:
        return cv2.blur(x, window, borderType=cv2.BORDER_REFLECT)

    centre = mean(small)
    cross = mean(small * level[..., None]) - centre * mean(level)[..., None]
    products = [mean(small * small[..., i : i + 1]) - centre * centre[..., i : i + 1] for i in range(3)]
    covariance = np.stack(products, -2) + epsilon * np.eye(3, dtype=np.float32)
    slope = _solve_symmetric(covariance, cross)
    offset = mean(level) - (slope * centre).sum(-1)
    slope, offset = (
        cv2.resize(mean(x), (width, height), interpolation=cv2.INTER_LINEAR) for x in (slope, offset)
    )
    return (slope * guide).sum(-1) + offset


def _solve_symmetric(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """x of symmetric 3x3 systems A x = b by the adjugate; [..., 3, 3], [..., 3] -> [..., 3]."""
    rows = [np.cross(matrix[..., i, :], matrix[..., j, :]) for i, j in ((1, 2), (2, 0), (0, 1))]
    determinant = (matrix[..., 0, :] * rows[0]).sum(-1, keepdims=True)
    return sum(rows[i] * vector[..., i : i + 1] for i in range(3)) / determinant


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, a cubic between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
