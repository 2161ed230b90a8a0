"""AKD-fan: AKD with the points of FAN, as the paper takes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.errors import DataError
from cap4d.evaluate.faces import mediapipe_missing
from cap4d.evaluate.metrics.keypoints import mean_distance
from cap4d.evaluate.metrics.metric import Better, NotMeasured
from cap4d.evaluate.metrics.network import Network
from cap4d.evaluate.metrics.warp import cut
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair

SIZE, MAP, COUNT = 256, 64, 68
REFERENCE, RAISED = 195.0, 0.12  # face_alignment's crop: the box's size it was trained with; up by its height
NEEDS = (
    "FAN as --fan FILE.onnx, float32[1, 3, 256, 256] in, heatmaps float32[1, 68, 64, 64] out: 2DFAN4 of "
    "https://github.com/1adrianb/face-alignment, exported with torch.onnx"
)


class FanDistance:
    """Average keypoint distance as `AKD`, with the 68 points of FAN: Bulat & Tzimiropoulos 2017, "How Far Are
    We from Solving the 2D & 3D Face Alignment Problem?"; px of an image whose larger side has 512.

    The network is the user's; it sees the square that the face_alignment package would cut out around the
    face's box, which here is that of MediaPipe's landmarks. A point is its heatmap's highest place, a quarter
    of a cell towards the higher neighbour. None unless MediaPipe finds a face in both.
    """

    name, unit, decimals = "AKD-fan", "px at 512", 3
    better: Better = "lower"

    def __init__(self, path: Path) -> None:
        self._network = Network(path, size=SIZE)

    def measure(self, pair: Pair) -> float | None:
        both = pair.faces.both
        if both is None:
            return None
        image, truth = (self._points(*x) for x in zip((pair.image, pair.truth), both, strict=True))
        return pair.faces.scale * mean_distance(image, truth)

    def _points(self, image: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
        """[68, 2] px."""
        affine = face_square(landmarks)
        answers = self._network(cut(image, affine, SIZE))
        name, maps = list(answers.items())[-1]  # of a stack of hourglasses the last one's
        if maps.shape != (1, COUNT, MAP, MAP):
            expected = f"float32[1, {COUNT}, {MAP}, {MAP}]"
            raise DataError(self._network.path, name, expected=expected, found=list(maps.shape))
        return (peaks(maps[0]) * (SIZE / MAP) - affine[:, 2]) / affine[0, 0]


def face_square(landmarks: np.ndarray) -> np.ndarray:
    """[2, 3] map of the square around a face onto the network's input, as face_alignment's `crop`."""
    low, high = landmarks.min(0), landmarks.max(0)
    width, height = high - low
    side = 200 * (width + height) / REFERENCE
    scale = SIZE / max(side, 1e-6)
    corner = (low + high) / 2 - [0, RAISED * height] - side / 2
    return np.array([[scale, 0, -scale * corner[0]], [0, scale, -scale * corner[1]]])


def peaks(maps: np.ndarray) -> np.ndarray:
    """[K, 2] x and y of the highest places of maps [K, H, W], in cells from the corner."""
    count, height, width = maps.shape
    rows, columns = np.unravel_index(maps.reshape(count, -1).argmax(1), (height, width))
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)), mode="edge")
    k = np.arange(count)
    right, left = padded[k, rows + 1, columns + 2], padded[k, rows + 1, columns]
    below, above = padded[k, rows + 2, columns + 1], padded[k, rows, columns + 1]
    steps = 0.25 * np.stack([np.sign(right - left), np.sign(below - above)], 1)
    return np.stack([columns, rows], 1) + 0.5 + steps


def find(weights: Weights) -> FanDistance | NotMeasured:
    """
    Raises:
        ArgumentError: The file that was given is not there.
        DataError: It is no such network.
    """
    missing = NEEDS if weights.fan is None else mediapipe_missing()
    return NotMeasured("AKD-fan", missing) if missing else FanDistance(weights.fan)
