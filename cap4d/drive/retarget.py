"""Mesh vertices -> an avatar's expressions: ridge least squares against its own blendshapes (fact 52).

What a mesh sequence does not say cannot be recovered: expressions that no seen vertex shows (whatever moves
only the mouth's inside), gaze where the source's eyeballs stand still, and how the head moves. What the
blendshapes cannot say stays in the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.clip import Clip
from cap4d.errors import ArgumentError
from cap4d.rig.head import Subject
from cap4d.rotation import axis_angle_to_rotmat, rotmat_to_axis_angle

NOISE = 3e-5  # m per coordinate: motion below it is not worth an expression of 1 (the ridge)
MIN_EYE_POINTS = 20
MIN_GAZE = 2e-3  # rad; below it the eyeballs stand still
CHUNK = 64  # frames at a time, to bound memory
RIGID = 0.99  # a skin weight from which a point moves with the eyeball alone


@dataclass(frozen=True, eq=False)
class Retargeted:
    """T frames: `expr` float32[T, E], `eye_rot` float32[T, 3] rad, `residual_mm` float32[T] RMS."""

    rig_name: str
    expr: np.ndarray
    eye_rot: np.ndarray
    residual_mm: np.ndarray

    def clip(self, fps: float) -> Clip:
        """As something that drives an avatar."""
        zeros = np.zeros_like(self.eye_rot)
        return Clip(self.rig_name, fps, self.expr, self.eye_rot, zeros, zeros)


class Retargeter:
    """Vertices of one topology -> expressions of one avatar; the normal equations are solved once.

    Args:
        bundle: The avatar. Its grid says which mesh vertices each of its points mixes.
        count: Vertices of a frame; grid points that need others are left out.
        noise: Ridge, see `NOISE`.
    Raises:
        ArgumentError: The mesh covers less of the grid than it takes to tell the expressions apart.
    """

    def __init__(self, bundle: Bundle, count: int, *, noise: float = NOISE) -> None:
        grid, subject = bundle.grid, bundle.subject
        self.rig_name, self.count = bundle.rig_name, count
        covered = (grid.vertices < count).all(1)
        weights = {driver: np.zeros(len(grid)) for driver in ("eyes", "expr")}
        for j, driver in enumerate(subject.joint_drivers):
            if driver in weights:
                weights[driver] += subject.skin_weights[:, j]
        still = covered & (weights["eyes"] < 1 - RIGID) & (weights["expr"] < 1 - RIGID)
        if 3 * still.sum() < bundle.n_expressions:
            raise ArgumentError(
                f"vertices: expected a mesh that covers the avatar's, got {still.sum()} points of it"
            )
        self._vertices, self._bary = grid.vertices[still], grid.bary[still]
        self._basis = _by_axis(subject.expression_basis[:, still]).reshape(bundle.n_expressions, -1)
        self._lids = _Lids(subject, still)
        normal = self._basis.astype(np.float64) @ self._basis.T.astype(np.float64)
        normal += noise**2 * np.eye(len(normal))
        self._expr_from_motion = np.linalg.solve(normal, self._basis.astype(np.float64)).astype(np.float32)
        self._eyes = [
            _EyePoints.of(grid.vertices[points], grid.bary[points], subject.expression_basis[:, points])
            for points in _eyeballs(subject.joint_drivers, subject.skin_weights, covered)
        ]

    def __call__(self, vertices: np.ndarray, template: np.ndarray) -> Retargeted:
        """Retargets T frames.

        Args:
            vertices: float32[T, count, 3] m.
            template: float32[count, 3] m, the same person's neutral face.
        """
        chunks = [self._chunk(vertices[at : at + CHUNK], template) for at in range(0, len(vertices), CHUNK)]
        expr, eye_rot, residual = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        return Retargeted(self.rig_name, expr, eye_rot, residual)

    def _chunk(self, vertices: np.ndarray, template: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        motion = _mix(vertices - template, self._vertices, self._bary).reshape(len(vertices), -1)  # by axis
        expr = motion @ self._expr_from_motion.T
        eye_rot = self._gaze(vertices, template, expr)
        if eye_rot.any():  # lids follow the eyes without an expression: take that motion away and solve again
            motion = motion - self._lids(expr, eye_rot)
            expr = motion @ self._expr_from_motion.T
        left = motion - expr @ self._basis
        return expr, eye_rot, 1e3 * np.sqrt(3 * np.einsum("ti,ti->t", left, left) / left.shape[1])

    def _gaze(self, vertices: np.ndarray, template: np.ndarray, expr: np.ndarray) -> np.ndarray:
        """[T, 3] the rotation that both eyeballs share (fact 5): Kabsch, about each one's own centre."""
        if not self._eyes:
            return np.zeros((len(vertices), 3), np.float32)
        covariance = np.zeros((len(vertices), 3, 3))
        for eye in self._eyes:
            posed, straight = _mix(vertices, eye.vertices, eye.bary), _mix(template, eye.vertices, eye.bary)
            straight = straight + (expr @ eye.basis).reshape(posed.shape)
            covariance += _centred(posed) @ _centred(straight).swapaxes(-1, -2)
        u, _, vt = np.linalg.svd(covariance)
        u[..., 2] *= np.linalg.det(u @ vt)[:, None]
        eye_rot = rotmat_to_axis_angle(u @ vt)
        return np.where(np.linalg.norm(eye_rot, axis=1, keepdims=True) < MIN_GAZE, 0, eye_rot).astype(
            np.float32
        )


@dataclass(frozen=True, eq=False)
class _EyePoints:
    """The points of an eyeball as mixtures of the mesh's; `basis` [E, 3 P] by axis."""

    vertices: np.ndarray
    bary: np.ndarray
    basis: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, bary: np.ndarray, basis: np.ndarray) -> _EyePoints:
        return cls(vertices, bary, _by_axis(basis).reshape(len(basis), -1))


class _Lids:
    """How points of the skin go with the eyes: little skin weights, and FLAME's pose correctives.

    Args:
        subject: The head.
        mask: bool[G] its P points.
    """

    def __init__(self, subject: Subject, mask: np.ndarray) -> None:
        self._eyes = [j for j, driver in enumerate(subject.joint_drivers) if driver == "eyes"]
        weights = subject.skin_weights[mask][:, self._eyes]
        near = np.flatnonzero(weights.any(1))
        chosen = np.flatnonzero(mask)[near]
        self._near, self._weights = near, weights[near]
        self._subject = _points_of(subject, chosen)
        self._joints = subject.joints[self._eyes], subject.joints_expression[:, self._eyes]
        self._count, self._correctives = int(mask.sum()), None
        if subject.pose_basis is not None:
            rows = [9 * j + entry for j in self._eyes for entry in range(9)]
            self._correctives = _by_axis(subject.pose_basis[rows][:, mask]).reshape(len(rows), -1)

    def __call__(self, expr: np.ndarray, eye_rot: np.ndarray) -> np.ndarray:
        """float32[T, 3 P] by axis: posed with `eye_rot` [T, 3] less posed without."""
        turn = axis_angle_to_rotmat(eye_rot) - np.eye(3, dtype=np.float32)
        moved = np.zeros((len(expr), 3, self._count), np.float32)
        if self._correctives is not None:
            entries = np.tile(turn.reshape(-1, 9), len(self._eyes))
            moved = (entries @ self._correctives).reshape(moved.shape)
        at = self._subject.pose(expr) + moved[..., self._near].swapaxes(-1, -2)
        joints = self._joints[0] + np.tensordot(expr, self._joints[1], 1)
        for k in range(len(self._eyes)):
            arm = (at - joints[:, k : k + 1]) @ turn.swapaxes(-1, -2)
            moved[..., self._near] += (self._weights[:, k, None] * arm).swapaxes(-1, -2)
        return moved.reshape(len(expr), -1)


def _points_of(subject: Subject, chosen: np.ndarray) -> Subject:
    """The subject on some of its points; contiguous, or every pose would copy the bases."""
    names = ("neutral", "expression_basis", "skin_weights", "pose_basis", "pose_offset")
    values = {name: getattr(subject, name) for name in names}
    changes = {n: np.ascontiguousarray(v[..., chosen, :]) for n, v in values.items() if v is not None}
    return replace(subject, **changes)


def _eyeballs(drivers: tuple[str, ...], weights: np.ndarray, covered: np.ndarray) -> list[np.ndarray]:
    """Per eye joint the grid points that move rigidly with it, where there are enough of them."""
    masks = [covered & (weights[:, j] > RIGID) for j, driver in enumerate(drivers) if driver == "eyes"]
    return [mask for mask in masks if mask.sum() >= MIN_EYE_POINTS]


def _centred(points: np.ndarray) -> np.ndarray:
    return points.astype(np.float64) - points.mean(-1, keepdims=True, dtype=np.float64)


def _by_axis(points: np.ndarray) -> np.ndarray:
    """[..., P, 3] -> contiguous [..., 3, P]: all x, all y, all z. Mixing runs several times faster on it."""
    return np.ascontiguousarray(points.swapaxes(-1, -2))


def _mix(values: np.ndarray, vertices: np.ndarray, bary: np.ndarray) -> np.ndarray:
    """[..., V, 3] -> [..., 3, P]"""
    values = _by_axis(values)
    return sum(values.take(vertices[:, corner], axis=-1) * bary[:, corner] for corner in range(3))
