"""Expression and head pose as this project's own landmark solver sees them: AED-mp and APD-mp.

These are not the paper's AED and APD, whose numbers come from DECA; they need no weights.
"""

from __future__ import annotations

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.face_solver import Face, FaceSolver, look
from cap4d.errors import ArgumentError
from cap4d.evaluate.metrics.metric import Better, NotMeasured
from cap4d.evaluate.pair import Pair
from cap4d.rotation import rotmat_to_axis_angle


class ExpressionSolver:
    """Solves the faces of a pair on the landmarks of the avatar's head; remembers the last pair's.

    Args:
        bundle: The avatar; 1 to 2 s are spent on finding its landmarks.
    Raises:
        ArgumentError: No face is seen in the avatar's picture.
    """

    def __init__(self, bundle: Bundle) -> None:
        from cap4d.drive.landmark_head import find_landmark_head
        from cap4d.track.landmarks import without_native_chatter

        with without_native_chatter():
            head = find_landmark_head(bundle)
        limits = np.asarray(head.expression_range, np.float64)
        self.spans = limits[:, 1] - limits[:, 0]
        self._solver = FaceSolver(head)
        self._last: tuple[Pair | None, tuple[Face, Face] | None] = None, None

    def __call__(self, pair: Pair) -> tuple[Face, Face] | None:
        """The faces of image and truth, or None unless both could be solved."""
        if self._last[0] is not pair:
            self._last = pair, self._solve(pair)
        return self._last[1]

    def _solve(self, pair: Pair) -> tuple[Face, Face] | None:
        both = pair.faces.both
        if both is None:
            return None
        height, width = pair.faces.size
        sights = [look(points, width, height) for points in both]
        faces = [None if sight is None else self._solver.fresh(sight) for sight in sights]
        return None if None in faces else (faces[0], faces[1])


class TrackedExpressionDistance:
    """Mean over expressions of how far the picture's weight is from the truth's, in parts of their range.

    Both images' landmarks are solved alike for pose and expressions of the avatar's own head
    (drive/face_solver.py), and only expressions that landmarks show count. None unless both are solved.
    """

    name, unit, decimals = "AED-mp", "of range", 4
    better: Better = "lower"

    def __init__(self, solver: ExpressionSolver) -> None:
        self._solver = solver

    def measure(self, pair: Pair) -> float | None:
        faces = self._solver(pair)
        if faces is None:
            return None
        shown = self._solver.spans > 0
        apart = np.abs(faces[0].expr - faces[1].expr)[shown] / self._solver.spans[shown]
        return float(apart.mean())


class TrackedPoseDistance:
    """Angle of the rotation from the head of the truth to that of the picture, degrees.

    Solved as for AED-mp. None unless both are solved.
    """

    name, unit, decimals = "APD-mp", "deg", 3
    better: Better = "lower"

    def __init__(self, solver: ExpressionSolver) -> None:
        self._solver = solver

    def measure(self, pair: Pair) -> float | None:
        faces = self._solver(pair)
        if faces is None:
            return None
        turn = rotmat_to_axis_angle(faces[0].rotmat @ faces[1].rotmat.T)
        return float(np.degrees(np.linalg.norm(turn)))


def find(
    bundle: Bundle | None,
) -> tuple[TrackedExpressionDistance | NotMeasured, TrackedPoseDistance | NotMeasured]:
    """Both metrics for an avatar."""
    needs = "an avatar in whose picture MediaPipe sees a face"
    try:
        solver = None if bundle is None else ExpressionSolver(bundle)
    except ArgumentError:
        solver = None
    if solver is None:
        return NotMeasured("AED-mp", needs), NotMeasured("APD-mp", needs)
    return TrackedExpressionDistance(solver), TrackedPoseDistance(solver)
