"""The avatar's mesh from frame to frame: the head rig on the grid and the network's correction, in C++."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cap4d import _core
from cap4d.bundle.bundle import Bundle
from cap4d.player.deformer import Deformer
from cap4d.player.stages import Stages
from cap4d.rig.head import Subject
from cap4d.rotation import axis_angle_to_rotmat

Rotation = np.ndarray | None
"""float32[3] axis-angle, rad; None is no rotation."""


class Surface:
    """Poses the grid's vertices as `Subject.pose` does (facts 6, 7, 20, 24), without allocating.

    Args:
        subject: The head on the grid's vertices, with what the tier folds into it.
        bundle: Whose grid and neutral correction.
        deformer: The network, or None.
        threads: 0: all.
    """

    def __init__(
        self, subject: Subject, bundle: Bundle, deformer: Deformer | None, *, threads: int = 0
    ) -> None:
        self.subject, self.deformer, self.threads = subject, deformer, threads
        grid, self._expressions = bundle.grid, len(subject.expression_basis)
        neutral, basis = subject.neutral, [subject.expression_basis]
        if subject.pose_offset is not None:
            neutral = neutral + subject.pose_offset
        if subject.pose_basis is not None:
            basis.append(subject.pose_basis)
        # The rig's own triangles have no map: one pixel stands in, which nothing reads or writes.
        size = max(1, grid.size)
        pixels = np.zeros((len(grid), 2), np.int16) if grid.is_mesh else grid.pixels
        self._pixels = np.ascontiguousarray(pixels[:, 0].astype(np.int32) * size + pixels[:, 1])
        self._core = _core.GridSurface(
            _floats(neutral),
            _floats(np.concatenate(basis)),
            _floats(subject.skin_weights.T),
            self._pixels,
            size,
            np.ascontiguousarray(grid.deformable),
            _floats(bundle.deform_neutral),
        )
        self._coefficients, self._late = (np.zeros(sum(map(len, basis)), np.float32) for _ in range(2))
        self._offsets = np.zeros((3, size, size), np.float32)
        self._zero = np.zeros(self._expressions, np.float32)
        self._neutral_answer, self._deformable = bundle.deform_neutral, bundle.grid.deformable
        self._linear = None if subject is bundle.subject else bundle.deform_linear  # what the tier folds in
        self._answer: np.ndarray | None = None  # the network's, of the last frame
        self._rest = self._pose_rig_axes(None)

    def pose(
        self,
        expr: np.ndarray,
        out: np.ndarray,
        *,
        eye_rot: Rotation = None,
        neck_rot: Rotation = None,
        jaw_rot: Rotation = None,
        stages: Stages,
    ) -> None:
        """Writes the posed vertices, float32[G, 3] m, head frame, OpenCV axes, into `out`."""
        with stages.time("rig"):
            rest = offsets = None
            if self.deformer is not None:
                rest = self._rest if jaw_rot is None else self._pose_rig_axes(jaw_rot)
                offsets = self._offsets
            turns = self._set(expr, eyes=eye_rot, neck=neck_rot, jaw=jaw_rot)
            self._core.pose(out, offsets, self._coefficients, self._late, turns, rest, self.threads)
        with stages.time("deform"):
            self._answer = None if self.deformer is None else self.deformer(offsets)
            self._core.deform(out, self._answer, self.threads)

    def deformation(self) -> np.ndarray:
        """float32[G, 3] m, head frame, OpenCV axes: what the network or its stand-in moved last frame."""
        moved = self._neutral_answer.copy()
        where = self._deformable
        if self._answer is not None:
            moved[where] = self._answer.reshape(3, -1)[:, self._pixels[where]].T
        elif self._linear is not None:
            expr = self._coefficients[: self._expressions]
            moved += np.tensordot(expr, self._linear, 1) * np.float32([1, -1, -1])
        return moved

    def _pose_rig_axes(self, jaw_rot: Rotation) -> np.ndarray:
        """float32[G, 3] m: the face at rest, with a turned jaw."""
        out = np.empty(self.subject.neutral.shape, np.float32)
        turns = self._set(self._zero, jaw=jaw_rot)
        self._core.pose(out, None, self._coefficients, self._late, turns, None, self.threads)
        out[:, 1:] *= -1
        return out

    def _set(self, expr: np.ndarray, **rotations: Rotation) -> list[tuple[int, bool, np.ndarray, np.ndarray]]:
        """Fills in the coefficients; returns the joints that turn."""
        self._coefficients[: self._expressions], self._coefficients[self._expressions :] = expr, 0
        self._late.fill(0)
        turns = list(self._turns(expr, rotations))
        if self.subject.pose_basis is not None:
            for joint, late, turn, _ in turns:
                at = self._expressions + 9 * joint
                (self._late if late else self._coefficients)[at : at + 9] = turn.ravel()
        return turns

    def _turns(
        self, expr: np.ndarray, rotations: dict[str, Rotation]
    ) -> Iterator[tuple[int, bool, np.ndarray, np.ndarray]]:
        subject = self.subject
        if subject.expr_rotation is not None:
            rotations = rotations | {"expr": expr @ subject.expr_rotation}
        for joint, driver in enumerate(subject.joint_drivers):
            rotation = rotations.get(driver)
            if rotation is not None:
                turn = axis_angle_to_rotmat(rotation) - np.eye(3, dtype=np.float32)
                pivot = subject.joints[joint] + expr @ subject.joints_expression[:, joint]
                yield joint, driver == "neck", _floats(turn), _floats(pivot)


def _floats(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)
