"""AKD: how far the points of the face are from where they should be."""

from __future__ import annotations

import numpy as np

from cap4d.evaluate.metrics.metric import Better
from cap4d.evaluate.pair import Pair

IBUG_68 = (
    *(127, 234, 93, 132, 58, 136, 150, 176, 152, 400, 379, 365, 288, 361, 323, 454, 356),  # jaw
    *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300),  # brows
    *(168, 197, 5, 4, 75, 97, 2, 326, 305),  # nose
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),  # eyes
    *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),  # outer lips
    *(78, 82, 13, 312, 308, 317, 14, 87),  # inner lips
)
"""Those of MediaPipe's landmarks that lie where the 68 points of iBUG 300-W (Sagonas et al. 2013) do."""


class KeypointDistance:
    """Average keypoint distance: mean over 68 points of the face of the distance between where they are in
    the picture and in the truth, px of an image whose larger side has 512.

    Siarohin et al. 2019, "First Order Motion Model for Image Animation", section 4; the paper's (fact 74)
    takes the 68 points from FAN (Bulat & Tzimiropoulos 2017). These are the same points as found by
    MediaPipe 0.10.21, the mean over four wobbled copies of each image. None unless a face is found in both.

    MediaPipe's own noise is 0.6 px: the mean distance of a talking head's points from where a move of the
    whole frame puts them.
    """

    name, unit, decimals = "AKD", "px at 512", 3
    better: Better = "lower"

    def measure(self, pair: Pair) -> float | None:
        both = pair.faces.both
        if both is None:
            return None
        return pair.faces.scale * mean_distance(*(points[list(IBUG_68)] for points in both))


def mean_distance(image: np.ndarray, truth: np.ndarray) -> float:
    """Of points [P, 2]."""
    return float(np.linalg.norm(image - truth, axis=1).mean())
