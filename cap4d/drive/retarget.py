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
from cap4d.rotation import rotmat_to_axis_angle

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
        weights = {driver: np.zeros(len(grid.pixels)) for driver in ("eyes", "expr")}
        for j, driver in enumerate(subject.joint_drivers):
            if driver in weights:
                weights[driver] += subject.skin_weights[:, j]
        still = covered & (weights["eyes"] < 1 - RIGID) & (weights["expr"] < 1 - RIGID)
        if 3 * still.sum() < bundle.n_expressions:
            raise ArgumentError(
                f"vertices: expected a mesh that covers the avatar's, got {still.sum()} points of it"
            )
        self._vertices, self._bary = grid.vertices[still], grid.bary[still]
        self._subject = _points_of(subject, still)
        self._basis = _by_axis(self._subject.expression_basis).reshape(bundle.n_expressions, -1)
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
            with_gaze, without = self._subject.pose(expr, eye_rot=eye_rot), self._subject.pose(expr)
            motion = motion - _by_axis(with_gaze - without).reshape(motion.shape)
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


def _points_of(subject: Subject, mask: np.ndarray) -> Subject:
    """The subject on some of its points."""
    changes = {
        name: getattr(subject, name)[..., mask, :] for name in ("neutral", "expression_basis", "skin_weights")
    }
    for name in ("pose_basis", "pose_offset"):
        if getattr(subject, name) is not None:
            changes[name] = getattr(subject, name)[..., mask, :]
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
