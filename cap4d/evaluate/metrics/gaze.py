"""Gaze error, from where the irises are between the corners of the eyes."""

from __future__ import annotations

import numpy as np

from cap4d.evaluate.metrics.eyes import aspect_ratios, gazes, iris_diameters
from cap4d.evaluate.metrics.metric import Better
from cap4d.evaluate.pair import Pair

SHUT = 0.15  # aspect ratio below which an iris is guessed rather than seen


class GazeError:
    """Mean angle between the gaze of an eye in the picture and in the truth, degrees.

    Gaze is that of an eyeball of 12 mm whose iris of 11.7 mm MediaPipe saw (`eyes.gazes`): relative to the
    middle of the eye's corners, so a head in the wrong place or turned too far is not counted here. What
    corner and eyeball differ by cancels, being the same in both. The truth's irises give the scale of both
    images. Eyes that are shut in one of them (aspect ratio under 0.15) do not count; None if no eye does.

    The eyeball model is that of Wood & Bulling 2014, "EyeTab"; not in CAP4D's paper. MediaPipe's own noise is
    0.7 degrees (frames of a talking head against the same frames moved by 4 to 15 px).
    """

    name, unit, decimals = "gaze", "deg", 2
    better: Better = "lower"

    def measure(self, pair: Pair) -> float | None:
        both = pair.faces.both
        if both is None:
            return None
        image, truth = both
        seen = (aspect_ratios(image) >= SHUT) & (aspect_ratios(truth) >= SHUT)
        diameters = iris_diameters(truth)
        angles = _angles(gazes(image, diameters), gazes(truth, diameters))
        return float(np.degrees(angles[seen].mean())) if seen.any() else None


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """rad, between unit vectors [N, 3]; exact for small ones, where the arc cosine is not."""
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
