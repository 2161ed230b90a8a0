"""Landmarks of a picture -> expressions of an avatar's own rig, gaze and head pose, in a few milliseconds.

The unknown head pose and the expressions are solved together: Gauss-Newton steps on the landmarks' distances
in the picture, the rig's landmark motion being linear. The energy is the offline tracker's (track/solve.py)
for one frame. What a person's face has of its own comes in through `offset` (see neutral.py); how wide the
lids of a person open against the avatar's, through a gain on their motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.drive.bounded import solve_bounded
from cap4d.drive.landmark_head import LandmarkHead
from cap4d.rotation import axis_angle_to_rotmat, skew
from cap4d.track.landmark_sets import CHIN, FEATURES, GAPS, LEFT_LIDS, OVAL, RIGHT_LIDS, RIGID

N_SKIN = 468
IRISES = (468, 473)  # centres: right, left
FACE_SIZE = 300.0  # residuals are in px of a face this wide
FOCAL = 1.3  # of the picture's larger side: nothing tells focal length from distance
MIN_FACE, MAX_PX = 24.0, 1e5  # a face of fewer px says nothing; no landmark is farther away, nor NaN
PLAIN, FEATURE, OUTLINE, CHINS, IRIS, GAP = 0.15, 0.5, 0.02, 0.3, 2.0, 1.0  # weights of landmarks
OUTLIER, LID_OUTLIER = 3.0, 30.0  # px from which residuals count linearly; lids move far in one frame
RIDGE, SPARSE = 20.0, 60.0  # of squared expressions; of the sum of non-negative ones
SIGNED_RIDGE = 20.0  # of expressions that go both ways, where a sum says nothing
GAZE = 5.0  # per rad^2 from straight ahead
EYE_RADIUS = 0.0125  # m from an eyeball's centre to its pupil (facts of anatomy: 24 mm across)
MAX_GAZE = np.radians([30.0, 40.0])  # pitch, yaw
FIRST_STEPS, STEPS = 15, 2
LOST = 20.0  # px: the face is not where it was
"""Root mean square beyond which the pose of the last frame is dropped and the search starts anew."""
LIDS = (RIGHT_LIDS, LEFT_LIDS)
LID_PAIRS = (((159, 145), (158, 153), (160, 144)), ((386, 374), (385, 380), (387, 373)))
WINK = 0.75  # an eye less open than this takes part in a blink of both, whose mean then holds
HALF, CLOSED = 0.7, 0.4
"""Of the open lids' distance: from here on it shrinks faster, and this much landmarks still show of shut lids
(0.1 to 0.4 on pictures of shut eyes)."""


@dataclass(frozen=True, eq=False)
class Face:
    """What a frame's landmarks say.

    Args:
        expr: float64[E]; gaze: [2] pitch and yaw of the eyeballs, rad.
        rotmat, tra: [3, 3] and [3] m, the head's pose before the camera, rig axes.
        residual: Root mean square distance of the features, px of a 300 px face.
    """

    expr: np.ndarray
    gaze: np.ndarray
    rotmat: np.ndarray
    tra: np.ndarray
    residual: float


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame's landmarks as rays of a camera.

    Args:
        rays: float64[478, 2] right and down, at depth 1.
        scale: From rays to px of a 300 px face.
        roll: rad, of the line through the eyes, counter-clockwise in the picture.
        size: [2] width and height of the landmarks along that line and across, as `rays`.
    """

    rays: np.ndarray
    scale: float
    roll: float
    size: np.ndarray


def look(points: np.ndarray, width: int, height: int) -> Sight | None:
    """Landmarks [478, 2] px (pixel centres at .5) of a picture; None: no face that could be told apart."""
    if points.shape != (478, 2) or not (np.abs(points) < MAX_PX).all():
        return None
    focal = FOCAL * max(width, height)
    rays = (points.astype(np.float64) - [width / 2, height / 2]) / focal
    across = rays[LEFT_LIDS[0]] - rays[RIGHT_LIDS[0]]
    roll = float(np.arctan2(-across[1], across[0]))
    cos, sin = np.cos(roll), np.sin(roll)
    level = rays[:N_SKIN] @ np.array([[cos, sin], [-sin, cos]])
    size = np.ptp(level, axis=0)
    face = float(np.sqrt(size.prod()))
    if face * focal < MIN_FACE or size.min() < 0.2 * size.max():
        return None
    return Sight(rays, FACE_SIZE / face, roll, size)


class FaceSolver:
    """Solves frame after frame, each from where the last one was.

    Args:
        head: The avatar's.
    """

    def __init__(self, head: LandmarkHead) -> None:
        subject, self.head = head.subject, head
        n = len(subject.expression_names)
        self.rest = subject.pose(np.zeros(n))[:N_SKIN].astype(np.float64)
        self.motion = np.ascontiguousarray(_motion(head)[:, :N_SKIN].transpose(1, 2, 0))  # [P, 3, E]
        self.low, self.high = np.asarray(head.expression_range, np.float64).T
        self.weights = _weights(head.known)
        self.gaps = np.array([pair for pair in GAPS if head.known[list(pair)].all()]).T
        self._rigid = np.array([i for i in RIGID if head.known[i]])
        self.outliers = np.full(N_SKIN, OUTLIER)
        self.outliers[[i for lids in LIDS for i in lids]] = LID_OUTLIER
        signed = self.low < 0
        self._ridge = np.where(signed, SIGNED_RIDGE, RIDGE)
        self._sparse = np.where(signed, 0, SPARSE / 2)
        self._last: Face | None = None

    def reset(self) -> None:
        """The next face may be anywhere."""
        self._last = None

    def __call__(self, sight: Sight, offset: np.ndarray) -> Face | None:
        """Solves a frame.

        Args:
            offset: float64[478, 3] m, from the avatar's landmarks at rest to the person's.
        Returns:
            None where the landmarks are no face.
        """
        starts = [self._last] if self._last is not None else []
        for start in (*starts, None):
            face = self._solve(sight, offset, start)
            if face is not None and face.residual < LOST:
                self._last = face
                return face
        self._last = None
        return None

    def resting(self, sight: Sight) -> Face:
        """The pose in which the avatar's own resting face lies nearest, by what expressions hardly move."""
        return self._placed(sight, self.rest, _start(sight, self.rest))

    def fresh(self, sight: Sight) -> Face | None:
        """The frame as if the avatar's own person were in it, without a memory."""
        face, none = None, np.zeros((478, 3))
        for _ in range(2):
            face = self._solve(sight, none, face)
            if face is None:
                break
        return face

    def landmarks(self, expr: np.ndarray | None = None) -> np.ndarray:
        """[478, 3] m the avatar's landmarks with an expression; of the irises the pupils only."""
        points = np.zeros((478, 3))
        points[:N_SKIN] = self.rest if expr is None else self.rest + self.motion @ expr
        if self.head.eyes is not None:
            points[list(IRISES)] = self.head.eyes + [0, 0, EYE_RADIUS]
        return points

    @staticmethod
    def pupil_motion(gaze: np.ndarray) -> np.ndarray:
        """[3] m"""
        return EYE_RADIUS * np.array([gaze[1], -gaze[0], 0])

    def _solve(self, sight: Sight, offset: np.ndarray, start: Face | None) -> Face | None:
        rest = self.rest + offset[:N_SKIN]
        face = start if start is not None else self._placed(sight, rest, _start(sight, rest))
        expr = face.expr if start is not None else np.zeros(len(self.low))
        rotmat, tra = face.rotmat, face.tra
        for _ in range(STEPS):
            rays = self._with_lid_gains(sight, rest, rotmat, tra)
            step = _Step(rays, sight.scale, rest, self.motion, expr, rotmat, tra, self.outliers)
            normal, right = step.normal_equations(self.weights, self.gaps)
            at = np.arange(6, 6 + len(expr))
            normal[at, at] += self._ridge
            right[6:] -= self._sparse
            free = np.full(6, np.inf)
            low, high = np.concatenate([-free, self.low]), np.concatenate([free, self.high])
            x = solve_bounded(normal, right, low, high, np.concatenate([np.zeros(6), expr]))
            rotmat, tra = step.moved(x[:6])
            expr = x[6:]
            if not np.isfinite(tra).all() or tra[2] > 0:
                return None
        residual = float(
            np.sqrt((self.weights * step.residual(self.motion @ expr)).sum() / self.weights.sum())
        )
        gaze = self._gaze(sight, rest, offset, rotmat, tra)
        return Face(expr, gaze, rotmat, tra, residual)

    def _with_lid_gains(self, sight: Sight, rest: np.ndarray, rotmat: np.ndarray, tra: np.ndarray):
        """[468, 2] rays that move the avatar's lids as far as the person's move."""
        still = project(rest @ rotmat.T + tra)[0]
        rays = sight.rays[:N_SKIN].copy()
        opened = lid_distances(rays) / np.maximum(lid_distances(still), 1e-9)
        for lids, gain in zip(LIDS, lid_gains(self.rest, rest, opened), strict=True):
            at = list(lids)
            rays[at] = still[at] + gain * (rays[at] - still[at])
        return rays

    def _placed(self, sight: Sight, rest: np.ndarray, face: Face) -> Face:
        """Gauss-Newton on the pose alone."""
        rotmat, tra = face.rotmat, face.tra
        rays, rest = sight.rays[self._rigid], rest[self._rigid]
        ones, nothing = np.ones(len(rest)), np.zeros((len(rest), 3, 0))
        for _ in range(FIRST_STEPS):
            step = _Step(rays, sight.scale, rest, nothing, np.zeros(0), rotmat, tra)
            normal, right = step.normal_equations(ones, None)
            x = np.linalg.solve(normal, right)
            rotmat, tra = step.moved(np.clip(x, -0.3, 0.3))
            if np.abs(x).max() < 1e-4:
                break
        return Face(np.zeros(0), np.zeros(2), rotmat, tra, 0.0)

    def _gaze(self, sight, rest, offset, rotmat, tra) -> np.ndarray:
        """[2] pitch and yaw that put the pupils where the irises are, as far as the lids are open."""
        if self.head.eyes is None:
            return np.zeros(2)
        pupils = (self.landmarks() + offset)[list(IRISES)]
        projected, slope = project(pupils @ rotmat.T + tra)
        turn = np.stack([self.pupil_motion(axis) for axis in np.eye(2)], 1)
        rows = (sight.scale * (slope @ rotmat @ turn)).reshape(-1, 2)
        left = (sight.scale * (sight.rays[list(IRISES)] - projected)).reshape(-1)
        weight = np.repeat(IRIS * np.clip((openness(sight, rest, rotmat, tra) - 0.4) / 0.3, 0, 1), 2)
        normal = (rows.T * weight) @ rows + GAZE * np.eye(2)
        return np.clip(np.linalg.solve(normal, (rows.T * weight) @ left), -MAX_GAZE, MAX_GAZE)


class _Step:
    """The picture of a face, and how it changes with pose and expression."""

    def __init__(self, rays, scale, rest, motion, expr, rotmat, tra, outliers=OUTLIER) -> None:
        self.rotmat, self.tra, self.expr, self.outliers = rotmat, tra, expr, outliers
        self.arm = (rest + motion @ expr) @ rotmat.T
        self.pivot = self.arm.mean(0)
        projected, slope = project(self.arm + tra)
        self.off = scale * (rays - projected)  # [P, 2] from the model to the landmarks, px of a 300 px face
        self.by_motion = scale * (slope @ rotmat)  # [P, 2, 3]
        turn = -skew(self.arm - self.pivot)
        self.rows = np.concatenate([scale * (slope @ turn), scale * slope, self.by_motion @ motion], 2)

    def residual(self, motion: np.ndarray) -> np.ndarray:
        """[P] squares of what is left after another expression's `motion` [P, 3]; the pose as it was."""
        before = self.rows[:, :, 6:] @ self.expr
        after = (self.by_motion @ motion[:, :, None])[..., 0]
        return ((self.off + before - after) ** 2).sum(-1)

    def normal_equations(self, weights, gaps) -> tuple[np.ndarray, np.ndarray]:
        """[6 + E, 6 + E] and [6 + E] for the change of pose and the expression itself."""
        off = self.off
        weight = weights * _trust(off, self.outliers)
        rows, off = self.rows, off + self.rows[:, :, 6:] @ self.expr
        if gaps is not None:
            upper, lower = gaps
            gap = self.off[upper] - self.off[lower]
            weight = np.concatenate([weight, GAP * _trust(gap, LID_OUTLIER)])
            rows = np.concatenate([rows, rows[upper] - rows[lower]])
            off = np.concatenate([off, off[upper] - off[lower]])
        root = np.sqrt(weight)[:, None]
        flat = (rows * root[..., None]).reshape(-1, rows.shape[2])
        return flat.T @ flat + 1e-6 * np.eye(flat.shape[1]), flat.T @ (off * root).reshape(-1)

    def moved(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pose after a turn about the face's middle and a shift."""
        turn = axis_angle_to_rotmat(change[:3])
        return turn @ self.rotmat, self.tra + change[3:] + self.pivot - turn @ self.pivot


def _trust(off: np.ndarray, outlier: np.ndarray | float) -> np.ndarray:
    """[P] weights that make squares of [P, 2] pseudo-Huber losses."""
    return 1 / np.sqrt(1 + (off**2).sum(-1) / outlier**2)


def project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [..., 3] before the camera, rig axes -> rays [..., 2], and how these change, [..., 2, 3]."""
    depth = np.maximum(-points[..., 2], 1e-3)
    rays = np.stack([points[..., 0], -points[..., 1]], -1) / depth[..., None]
    slope = np.zeros((*depth.shape, 2, 3))
    slope[..., 0, 0], slope[..., 1, 1] = 1 / depth, -1 / depth
    slope[..., 2] = rays / depth[..., None]
    return rays, slope


def unproject(rays: np.ndarray, rotmat: np.ndarray, tra: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[P, 3] head points that `rays` [P, 2] show at `depth` [P] m from the camera."""
    seen = np.concatenate([rays * [1, -1], -np.ones((len(rays), 1))], 1) * depth[:, None]
    return (seen - tra) @ rotmat


def openness(sight: Sight, rest: np.ndarray, rotmat: np.ndarray, tra: np.ndarray) -> np.ndarray:
    """[2] right and left: the distance of the lids against that of the person at rest."""
    still = project(rest @ rotmat.T + tra)[0]
    return lid_distances(sight.rays) / np.maximum(lid_distances(still), 1e-9)


def lid_distances(points: np.ndarray) -> np.ndarray:
    """[2] right and left: between the upper and the lower lid of points [P, 2 or 3]."""
    pairs = np.array(LID_PAIRS)
    return np.linalg.norm(points[pairs[..., 0]] - points[pairs[..., 1]], axis=-1).mean(1)


def lid_gains(avatar: np.ndarray, person: np.ndarray, opened: np.ndarray) -> np.ndarray:
    """[2] right and left: what a motion of the person's lids is on the avatar.

    Small motions keep their share of the open eye; the rest grows so that both close together.

    Args:
        avatar, person: [P, 3] m, at rest.
        opened: [2] see `openness`.
    """
    both = np.clip((WINK - opened.max()) / 0.1, 0, 1)
    meant = opened + both * (opened.mean() - opened)
    shown = np.where(meant > HALF, meant, HALF * (meant - CLOSED) / (HALF - CLOSED)).clip(0)
    growth = (1 - shown) / np.maximum(1 - np.minimum(opened, 0.99), 0.01)
    growth = np.where(meant > HALF, 1, growth)
    return np.clip(growth * lid_distances(avatar) / np.maximum(lid_distances(person), 1e-4), 0.4, 3)


def _start(sight: Sight, rest: np.ndarray) -> Face:
    """The head upright along the line of the eyes, as far away as it is small."""
    extent = np.ptp(rest, axis=0)
    depth = float(np.sqrt(extent[0] * extent[1] / sight.size.prod()))
    rotmat = axis_angle_to_rotmat(np.array([0, 0, sight.roll]))
    x, y = sight.rays[:N_SKIN].mean(0)
    return Face(np.zeros(0), np.zeros(2), rotmat, np.array([x, -y, -1]) * depth - rotmat @ rest.mean(0), 0.0)


def _motion(head: LandmarkHead) -> np.ndarray:
    """float64[E, P, 3] m per unit of each expression, with the turns of joints that expressions drive."""
    subject = head.subject
    unit = np.eye(len(subject.expression_names))
    low, high = np.asarray(head.expression_range, np.float64).T
    far, near = np.minimum(high, 1.0), np.maximum(low, -1.0)  # a secant: turns are not linear
    ends = [subject.pose(unit * end[:, None]) for end in (far, near)]
    return (ends[0] - ends[1]) / np.maximum(far - near, 1e-6)[:, None, None]


def _weights(known: np.ndarray) -> np.ndarray:
    """float64[468]"""
    weights = np.full(N_SKIN, PLAIN)
    weights[list(FEATURES)] = FEATURE
    weights[list(OVAL)] = OUTLINE
    weights[list(CHIN)] = CHINS
    return weights * known[:N_SKIN]
