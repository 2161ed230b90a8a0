"""What a person's face is at rest: without it, a small mouth would be an expression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.drive.face_solver import (
    IRISES,
    LIDS,
    Face,
    FaceSolver,
    Sight,
    unproject,
)

SECONDS = 1.0  # every frame of which is taken for a resting face
LONGER = 8.0  # s, in which some more are
EVERY = 0.2  # s
LEARNING = 30.0  # s in which what no expression explains becomes part of the resting face
LIKENESS, STRAIN = (2.6, 3.6), (2.0, 2.8)
"""How well an avatar's own face explains the person before the camera at rest, px of a 300 px face (root mean
square), and the sum of the expressions it needs for that: up to the first it is this very person, from the
second on a stranger. Measured: 2.2 and 1.4 for the person of the avatar, 2.6 and 2.9 for ICT's mean head."""
MOUTH_OPEN = 0.12  # lips' distance against the mouth's width from which a face is not at rest
INNER_LIPS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402))
LID_RIMS = [i for lids in LIDS for i in lids]


@dataclass(frozen=True, eq=False)
class _Resting:
    """What a frame gives if its face is at rest.

    Args:
        stranger, own: [478, 3] m, the offsets if the face is another's, and if it is that of the avatar's
            own person in the expression in which they rest.
        residual, strain: As of `LIKENESS` and `STRAIN`; much strain speaks against a face at rest.
    """

    stranger: np.ndarray
    own: np.ndarray
    residual: float
    strain: float


class Neutral:
    """A running estimate of where a person's landmarks lie on the avatar's head.

    From the first second, and less often from the next seven: the median over the least strained third of the
    faces with closed lips (of all, while there are none); then slow learning of what no expression explains.

    Args:
        solver: The avatar's.
    """

    def __init__(self, solver: FaceSolver) -> None:
        self.solver = solver
        self.restart()

    def restart(self) -> None:
        """Somebody else may sit down."""
        self.offset = np.zeros((478, 3))
        self._closed: list[_Resting] = []
        self._open: list[_Resting] = []
        self._began: float | None = None
        self._taken = self._learned = 0.0

    def before(self, sight: Sight, t: float) -> None:
        """Takes a frame in that is about to be solved, if it still counts."""
        self._began = t if self._began is None else self._began
        spent = t - self._began
        if spent > LONGER or (spent > SECONDS and t - self._taken < EVERY):
            return
        self._taken = t
        kept = self._closed if mouth_opening(sight.rays) < MOUTH_OPEN else self._open
        kept.append(self._at_rest(sight))
        if kept is self._closed or not self._closed:
            self.offset = _with_closed_lips(_middle(kept))

    def after(self, sight: Sight, face: Face, t: float) -> None:
        """Learns from a solved frame."""
        share = np.clip((t - self._learned) / LEARNING, 0, 0.02)
        self._learned = t
        if self._began is None or t - self._began <= LONGER:
            return
        change = share * (self._seen(sight, face, expr=face.expr) - self.offset)
        change[LID_RIMS] = 0
        self.offset = self.offset + change

    def _at_rest(self, sight: Sight) -> _Resting:
        face, own = self.solver.resting(sight), self.solver.fresh(sight)
        stranger = self._seen(sight, face, expr=None)
        if own is None:
            return _Resting(stranger, stranger, np.inf, np.inf)
        offset = self._seen(sight, own, expr=own.expr)
        return _Resting(stranger, offset, own.residual, float(np.abs(own.expr).sum()))

    def _seen(self, sight: Sight, face: Face, *, expr: np.ndarray | None) -> np.ndarray:
        """[478, 3] m: the offset that explains a frame, across the line of sight; eyes at rest are open."""
        points = self.solver.landmarks(expr)
        points[LID_RIMS] = self.solver.rest[LID_RIMS]
        if expr is not None:
            points[list(IRISES)] += self.solver.pupil_motion(face.gaze)
        depth = -(points + self.offset) @ face.rotmat[2] - face.tra[2]
        return unproject(sight.rays, face.rotmat, face.tra, depth) - points


def _middle(frames: list[_Resting]) -> np.ndarray:
    """[478, 3] the median of the least strained third."""
    frames = sorted(frames, key=lambda frame: frame.strain)[: -(-len(frames) // 3)]
    likeness = [
        (limits[1] - np.median([getattr(frame, name) for frame in frames])) / (limits[1] - limits[0])
        for name, limits in (("residual", LIKENESS), ("strain", STRAIN))
    ]
    share = np.clip(min(likeness), 0, 1)
    stranger, own = (
        np.median(np.stack([getattr(f, name) for f in frames]), 0) for name in ("stranger", "own")
    )
    return stranger + share * (own - stranger)


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
