"""CSIM: whether it is the same person, by ArcFace."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.evaluate.faces import mediapipe_missing
from cap4d.evaluate.metrics.metric import Better, NotMeasured
from cap4d.evaluate.metrics.network import Network
from cap4d.evaluate.metrics.warp import cut, similarity
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair

SIZE = 112
LENGTHS = (128, 256, 512)
PLACES = np.array(
    [[38.2946, 51.6963], [73.5318, 51.5014], [56.0252, 71.7366], [41.5493, 92.3655], [70.7299, 92.2041]]
)
"""Where ArcFace was trained to see eyes, tip of the nose, corners of the mouth (insightface, face_align)."""
POINTS = ((33, 133), (362, 263), (4,), (61,), (291,))
"""The same of MediaPipe's landmarks; an eye is the middle of its corners."""
NEEDS = (
    "an ArcFace network as --arcface FILE.onnx, float32[1, 3, 112, 112] in, 512 numbers out: w600k_r50.onnx "
    "of insightface's buffalo_l (https://github.com/deepinsight/insightface/releases, for research only)"
)


class IdentitySimilarity:
    """Cosine similarity of the identity vectors of picture and truth: 1 for the same face, about 0 for two
    strangers'.

    Deng et al. 2019, "ArcFace: Additive Angular Margin Loss for Deep Face Recognition"; the network is the
    user's. Each image's face is brought to ArcFace's five points by a similarity transform, and given as RGB
    in [-1, 1], as insightface does; the points come from MediaPipe. None unless a face is found in both.
    """

    name, unit, decimals = "CSIM", "", 4
    better: Better = "higher"

    def __init__(self, path: Path) -> None:
        self._network = Network(path, size=SIZE)

    def measure(self, pair: Pair) -> float | None:
        both = pair.faces.both
        if both is None:
            return None
        image, truth = (self._vector(*x) for x in zip((pair.image, pair.truth), both, strict=True))
        return float(np.clip(image @ truth, -1, 1))

    def _vector(self, image: np.ndarray, points: np.ndarray) -> np.ndarray:
        answers = self._network(2 * aligned_face(image, points) - 1)
        vector = self._network.flat(next(iter(answers)), answers, LENGTHS).astype(np.float64)
        return vector / max(np.linalg.norm(vector), 1e-12)


def aligned_face(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """float32[112, 112, 3] in [0, 1]: the face with landmarks [478, 2] where ArcFace wants it."""
    five = np.stack([points[list(group)].mean(0) for group in POINTS])
    return cut(image, similarity(five, PLACES), SIZE)


def find(weights: Weights) -> IdentitySimilarity | NotMeasured:
    """
    Raises:
        ArgumentError: The file that was given is not there.
        DataError: It is no such network.
    """
    missing = NEEDS if weights.arcface is None else mediapipe_missing()
    return NotMeasured("CSIM", missing) if missing else IdentitySimilarity(weights.arcface)
