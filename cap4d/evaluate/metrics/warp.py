"""Cutting faces out as networks want them: similarity transforms and sampling."""

from __future__ import annotations

import numpy as np


def similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[2, 3]: the turn, scale and shift that bring points [P, 2] nearest to others, without mirroring.

    Umeyama 1991, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns",
    eq. 40-42.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    mean_s, mean_t = source.mean(0), target.mean(0)
    s, t = source - mean_s, target - mean_t
    # In the plane, turn and scale are one complex number, and mirroring has no say.
    a, b = (s * t).sum(), (s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]).sum()
    scaled = np.array([[a, -b], [b, a]]) / max((s**2).sum(), 1e-12)
    return np.concatenate([scaled, (mean_t - scaled @ mean_s)[:, None]], 1)


def cut(image: np.ndarray, affine: np.ndarray, size: int) -> np.ndarray:
    """float32[size, size, 3]: `image` through a [2, 3] map of px from the corner, bilinear, black outside.

    Images that shrink are averaged first, as bilinear samples would skip pixels.
    """
    import cv2

    scale = float(np.sqrt(abs(np.linalg.det(affine[:, :2]))))
    image = np.asarray(image, np.float32)
    if scale < 0.6:
        sigma = 0.5 * (1 / scale - 1)
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    shifted = affine.copy()
    shifted[:, 2] += affine[:, :2] @ [0.5, 0.5] - 0.5  # OpenCV counts from pixel centres
    return cv2.warpAffine(image, shifted, (size, size), flags=cv2.INTER_LINEAR)
