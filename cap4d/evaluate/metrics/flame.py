"""AED and APD: expression and pose as a regressor of FLAME's parameters sees them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.errors import DataError
from cap4d.evaluate.faces import mediapipe_missing
from cap4d.evaluate.metrics.keypoints import IBUG_68
from cap4d.evaluate.metrics.metric import Better, NotMeasured
from cap4d.evaluate.metrics.network import Network
from cap4d.evaluate.metrics.warp import cut
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair

SIZE = 224
MARGIN = 1.1 * 1.25  # DECA's crop: this times the size of the box of 68 points
DECA_LENGTH = 236  # shape 100, texture 50, expression 50, pose 6, camera 3, light 27
DECA_EXPRESSION, DECA_POSE = slice(150, 200), slice(200, 206)
EXPRESSION_NAMES, POSE_NAMES = ("expression_params", "expression", "exp"), ("pose_params", "pose")
NEEDS = (
    "a regressor of FLAME's parameters as --flame-regressor FILE.onnx, float32[1, 3, 224, 224] in, and out "
    "either DECA's 236 numbers or outputs named expression and pose: DECA's E_flame "
    "(https://github.com/yfeng95/DECA) or SMIRK's encoder, exported with torch.onnx"
)


@dataclass(frozen=True, eq=False)
class FlameFace:
    """expr [50 or 100]; pose [3 or 6]: of the head, and of the jaw where the regressor says it, rad."""

    expr: np.ndarray
    pose: np.ndarray


class FlameRegressor:
    """The user's network on the faces of a pair; remembers the last pair's.

    Raises:
        DataError: Its outputs are neither DECA's nor named as expected.
    """

    def __init__(self, path: Path) -> None:
        self._network = Network(path, size=SIZE)
        names = self._network.outputs
        self._expression = next((n for n in EXPRESSION_NAMES if n in names), None)
        self._pose = next((n for n in POSE_NAMES if n in names), None)
        if (self._expression is None or self._pose is None) and len(names) != 1:
            expected = "one of DECA's 236 numbers, or expression and pose"
            raise DataError(path, "outputs", expected=expected, found=", ".join(names))
        self._last: tuple[Pair | None, tuple[FlameFace, FlameFace] | None] = None, None

    def __call__(self, pair: Pair) -> tuple[FlameFace, FlameFace] | None:
        """The faces of image and truth, or None unless a face is found in both."""
        if self._last[0] is not pair:
            both = pair.faces.both
            faces = None if both is None else (self._see(pair.image, both[0]), self._see(pair.truth, both[1]))
            self._last = pair, faces
        return self._last[1]

    def _see(self, image: np.ndarray, points: np.ndarray) -> FlameFace:
        answers = self._network(cut(image, face_box(points), SIZE))
        if self._expression is None or self._pose is None:
            all_of = self._network.flat(next(iter(answers)), answers, (DECA_LENGTH,))
            return FlameFace(all_of[DECA_EXPRESSION], all_of[DECA_POSE])
        expr = self._network.flat(self._expression, answers, (50, 100))
        return FlameFace(expr, self._network.flat(self._pose, answers, (3, 6)))


def face_box(points: np.ndarray) -> np.ndarray:
    """[2, 3] map of the square around landmarks [478, 2] onto the network's input, as in DECA's datasets.py
    for 68 points, whose box ends at the brows.
    """
    points = points[list(IBUG_68)]
    low, high = points.min(0), points.max(0)
    side = MARGIN * (high - low).sum() / 2  # width and height, averaged
    scale = SIZE / max(side, 1e-6)
    corner = (low + high) / 2 - side / 2
    return np.array([[scale, 0, -scale * corner[0]], [0, scale, -scale * corner[1]]])


class ExpressionDistance:
    """Average expression distance: mean absolute difference of FLAME's expression coefficients that the
    regressor sees in the picture and in the truth.

    Fact 74 names DECA (Feng et al. 2021, "Learning an Animatable Detailed 3D Face Model from In-The-Wild
    Images") and no norm: this is the mean over coefficients of the absolute difference. The crop is DECA's,
    around MediaPipe's landmarks. None unless a face is found in both.
    """

    name, unit, decimals = "AED", "", 4
    better: Better = "lower"

    def __init__(self, regressor: FlameRegressor) -> None:
        self._regressor = regressor

    def measure(self, pair: Pair) -> float | None:
        faces = self._regressor(pair)
        return None if faces is None else float(np.abs(faces[0].expr - faces[1].expr).mean())


class PoseDistance:
    """Average pose distance: the same as AED for FLAME's pose: the head's axis-angle and, where the regressor
    says it, the jaw's, rad.
    """

    name, unit, decimals = "APD", "rad", 4
    better: Better = "lower"

    def __init__(self, regressor: FlameRegressor) -> None:
        self._regressor = regressor

    def measure(self, pair: Pair) -> float | None:
        faces = self._regressor(pair)
        return None if faces is None else float(np.abs(faces[0].pose - faces[1].pose).mean())


def find(weights: Weights) -> tuple[ExpressionDistance | NotMeasured, PoseDistance | NotMeasured]:
    """
    Raises:
        ArgumentError: The file that was given is not there.
        DataError: It is no such network.
    """
    missing = NEEDS if weights.flame is None else mediapipe_missing()
    if missing:
        return NotMeasured("AED", missing), NotMeasured("APD", missing)
    regressor = FlameRegressor(weights.flame)
    return ExpressionDistance(regressor), PoseDistance(regressor)
