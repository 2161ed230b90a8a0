"""What a person's face is at rest: without it, a small mouth would be an expression."""

from __future__ import annotations

from collections import deque

import numpy as np

from cap4d.drive.face_solver import (
    IRISES,
    LIDS,
    Face,
    FaceSolver,
    Sight,
    unproject,
)

SECONDS = 1.0  # of frames make a resting face
PATIENCE = 4.0  # s, for frames in which the mouth is closed
KEPT = 45  # frames
LEARNING = 30.0  # s in which what no expression explains becomes part of the resting face
LIKENESS, STRANGER = 2.6, 3.6
"""px of a 300 px face: how well an avatar's own face explains the person in front of the camera, root mean
square. 2.3 for the person it was made of, 4.6 and more for others."""
MOUTH_OPEN = 0.12  # lips' distance against the mouth's width from which a face is not at rest
INNER_LIPS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402))


class Neutral:
    """A running estimate of where a person's landmarks lie on the avatar's head.

    The median over the first second of frames with closed lips, then slow learning.

    Args:
        solver: The avatar's.
    """

    def __init__(self, solver: FaceSolver) -> None:
        self.solver = solver
        self.restart()

    def restart(self) -> None:
        """Somebody else may sit down."""
        self.offset = np.zeros((478, 3))
        self._frames: deque[np.ndarray] = deque(maxlen=KEPT)
        self._open: deque[np.ndarray] = deque(maxlen=KEPT)
        self._began: float | None = None
        self._last = 0.0
        self.settled = False

    def before(self, sight: Sight, t: float) -> None:
        """While it settles: takes a frame in, before it is solved."""
        if self.settled:
            return
        self._began = t if self._began is None else self._began
        kept = self._frames if mouth_opening(sight.rays) < MOUTH_OPEN else self._open
        kept.append(self._at_rest(sight))
        self.offset = _with_closed_lips(np.median(np.stack(self._frames or self._open), 0))
        closed = len(self._frames) and self._spent(t) >= SECONDS
        self.settled = bool(closed or self._spent(t) >= PATIENCE)
        self._last = t

    def after(self, sight: Sight, face: Face, t: float) -> None:
        """Once it has settled: learns from a solved frame."""
        if not self.settled:
            return
        share = np.clip((t - self._last) / LEARNING, 0, 0.02)
        self._last = t
        seen = self._seen(sight, face, expr=face.expr)
        learns = np.ones(478, bool)
        learns[[i for lids in LIDS for i in lids]] = False
        self.offset[learns] += share * (seen - self.offset)[learns]

    def _spent(self, t: float) -> float:
        return t - (t if self._began is None else self._began)

    def _at_rest(self, sight: Sight) -> np.ndarray:
        """[478, 3] m: the offset of a resting face.

        An avatar of this very person explains it without one, and knows the expression that it rests in:
        the more so, the more that is taken over.
        """
        face = self.solver.resting(sight)
        alike = self.solver.fresh(sight)
        if alike is None:
            return self._seen(sight, face, expr=None)
        share = np.clip((STRANGER - alike.residual) / (STRANGER - LIKENESS), 0, 1)
        if share > 0.5:
            face = alike
        return self._seen(sight, face, expr=share * alike.expr)

    def _seen(self, sight: Sight, face: Face, *, expr: np.ndarray | None) -> np.ndarray:
        """[478, 3] m: the offset that explains a frame, across the line of sight."""
        points = self.solver.landmarks(expr)
        if expr is not None:
            points[list(IRISES)] += self.solver.pupil_motion(face.gaze)
        depth = -(points + self.offset) @ face.rotmat[2] - face.tra[2]
        return unproject(sight.rays, face.rotmat, face.tra, depth) - points


def mouth_opening(rays: np.ndarray) -> float:
    """The lips' distance against the mouth's width."""
    gaps = [np.linalg.norm(rays[upper] - rays[lower]) for upper, lower in INNER_LIPS[:3]]
    return float(np.mean(gaps) / max(np.linalg.norm(rays[78] - rays[308]), 1e-9))


def _with_closed_lips(offset: np.ndarray) -> np.ndarray:
    """Lips that touch touch on the avatar too, whatever the resting face has between them."""
    upper, lower = np.array(INNER_LIPS).T
    offset = offset.copy()
    offset[upper, 1] = offset[lower, 1] = (offset[upper, 1] + offset[lower, 1]) / 2
    return offset
