"""SSIM."""

from __future__ import annotations

from cap4d.evaluate.image import ssim
from cap4d.evaluate.metrics.metric import Better
from cap4d.evaluate.pair import Pair


class Ssim:
    """Structural similarity, 1 for equal images: Wang, Bovik, Sheikh, Simoncelli 2004, "Image Quality
    Assessment: From Error Visibility to Structural Similarity", eq. 13.

    Gaussian window 11x11 of sigma 1.5, where it fits; K1 = 0.01, K2 = 0.03, range 1; the mean over pixels and
    sRGB channels of the full image, unmasked.
    """

    name, unit, decimals = "SSIM", "", 4
    better: Better = "higher"

    def measure(self, pair: Pair) -> float:
        return ssim(pair.image, pair.truth)
