"""PSNR of the whole image, and of the person alone."""

from __future__ import annotations

import numpy as np

from cap4d.evaluate.image import mse, psnr_of_mse
from cap4d.evaluate.metrics.metric import Better
from cap4d.evaluate.pair import Pair

LEAST_MSE = 1e-10  # images equal to the bit count as 100 dB, not as infinity
SEEN = 0.5  # coverage from which a pixel shows the person


class Psnr:
    """Peak signal-to-noise ratio, dB: -10 log10 of the mean squared error of sRGB values in [0, 1].

    Over all pixels and channels of the full image, unmasked. Where the capture has mattes, or images with
    alpha, both are on white (the background removal of the paper's protocol), and the white counts.
    At most 100 dB.
    """

    name, unit, decimals = "PSNR", "dB", 2
    better: Better = "higher"

    def measure(self, pair: Pair) -> float:
        return psnr_of_mse(max(LEAST_MSE, mse(pair.image, pair.truth)))


class PersonPsnr:
    """The PSNR of the pixels that show the person (matte of at least 0.5), dB.

    It does not depend on how much background there is around the person, so it compares captures of different
    framing; it is blind to what the avatar paints beside them. Not in the paper. None without a matte.
    """

    name, unit, decimals = "PSNR-fg", "dB", 2
    better: Better = "higher"

    def measure(self, pair: Pair) -> float | None:
        seen = None if pair.coverage is None else pair.coverage >= SEEN
        if seen is None or not seen.any():
            return None
        return psnr_of_mse(max(LEAST_MSE, mse(pair.image[seen], np.asarray(pair.truth[seen]))))
