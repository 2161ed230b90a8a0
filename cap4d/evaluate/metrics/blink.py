"""Blink error, from how far the lids are apart."""

from __future__ import annotations

import numpy as np

from cap4d.evaluate.metrics.eyes import aspect_ratios
from cap4d.evaluate.metrics.metric import Better
from cap4d.evaluate.pair import Pair


class BlinkError:
    """Mean over both eyes of how far the eye aspect ratio in the picture is from that in the truth.

    The ratio (height over width) is about 0.3 for open eyes and under 0.15 for shut ones. Soukupová & Čech
    2016, "Real-Time Eye Blink Detection using Facial Landmarks", eq. 1, on MediaPipe's lids; not in CAP4D's
    paper. None unless a face is found in both. MediaPipe's own noise is 0.005 (see `gaze.py`).
    """

    name, unit, decimals = "blink", "EAR", 4
    better: Better = "lower"

    def measure(self, pair: Pair) -> float | None:
        both = pair.faces.both
        if both is None:
            return None
        image, truth = map(aspect_ratios, both)
        return float(np.abs(image - truth).mean())
