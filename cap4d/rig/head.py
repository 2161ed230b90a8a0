"""One head model for all: a linear shape space, a linear expression space, and a few rotating joints.

Blendshapes and linear blend skinning are written once here and serve NumPy arrays and torch tensors alike.
A rig may stand on any points that are barycentric mixtures of its mesh (`resample`): the whole mesh, tracked
landmarks, or the UV grid. No file access here (see store.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from cap4d.rotation import Array, axis_angle_to_rotmat, identity_like, namespace

JOINT_DRIVERS = ("neck", "jaw", "eyes", "expr")


@dataclass(frozen=True, eq=False)
class MouthPlacement:
    """Where a rig's rigid mouth cavity sits on a subject: from two anchors of the neutral shape (fact 12).

    Args:
        local: [V, 4] coordinates in the mouth's frame in units of its radius; 1 for mouth vertices, else 0.
        anchors: [2, 3] jaw joint and lip vertex of the template, m.
        anchors_identity: [S, 2, 3] their identity basis.
    """

    local: Array
    anchors: Array
    anchors_identity: Array

    def place(self, shape: Array) -> Array:
        """[V, 3] the mouth's vertices for identity `shape` [S], else zero. The constants are fact 12's."""
        jaw, lip = self.anchors + _combine(shape, self.anchors_identity)
        offset = lip - jaw
        distance = (offset * offset).sum() ** 0.5
        z_axis = offset / distance
        up = 0 * offset
        up[1] = 1
        xp = namespace(offset)
        x_axis = _cross(up, z_axis)
        x_axis = x_axis / (x_axis * x_axis).sum() ** 0.5
        frame = xp.stack([x_axis, _cross(z_axis, x_axis), z_axis])
        centre = jaw + 0.75 * offset - 0.005 * z_axis
        return (self.local[..., :3] @ frame * (0.25 * distance) + centre) * self.local[..., 3:]


@dataclass(frozen=True, eq=False)
class Subject:
    """A rig with its identity baked in: all that posing needs, and exactly what a bundle carries.

    Rig axes (y up, face to +z), metres; V points, E expressions, J joints.

    Args:
        rig_name: Name of the rig; expression vectors carry it too.
        expression_names: E names.
        neutral: [V, 3].
        expression_basis: [E, V, 3].
        joint_drivers: For each joint which rotation turns it: `neck`, `jaw`, `eyes` or `expr`.
        joints: [J, 3] positions at the neutral expression.
        joints_expression: [E, J, 3].
        skin_weights: [V, J]; the rest up to 1 stays with the head.
        expr_rotation: [E, 3] rad per unit of expression, for joints driven by `expr` (fact 13), or None.
        pose_basis: [9 J, V, 3] offsets per entry of (R_j - I), or None.
        pose_offset: [V, 3] constant offset of every evaluation (fact 8, `compat_pose_offset`), or None.
    """

    rig_name: str
    expression_names: tuple[str, ...]
    neutral: Array
    expression_basis: Array
    joint_drivers: tuple[str, ...]
    joints: Array
    joints_expression: Array
    skin_weights: Array
    expr_rotation: Array | None = None
    pose_basis: Array | None = None
    pose_offset: Array | None = None

    def pose(
        self,
        expr: Array,
        *,
        eye_rot: Array | None = None,
        neck_rot: Array | None = None,
        jaw_rot: Array | None = None,
    ) -> Array:
        """Posed vertices in the head's frame (before `rot` and `tra`).

        Every joint turns on its own about its own position, x -> R (x - J) + J; there is no chain (fact 7).
        `neck_rot` bends the neck and shoulders under a fixed head (fact 6).

        Args:
            expr: [..., E] in the rig's own expression space.
            eye_rot, neck_rot, jaw_rot: [..., 3] axis-angle, rad; None is no rotation.
        Returns:
            [..., V, 3] m, rig axes.
        """
        unskinned = self.neutral + _combine(expr, self.expression_basis)
        joints = self.joints + _combine(expr, self.joints_expression)
        turns = self._turns(expr, eyes=eye_rot, neck=neck_rot, jaw=jaw_rot)
        if self.pose_offset is not None:
            unskinned = unskinned + self.pose_offset
        if self.pose_basis is not None:
            for j, turn in turns.items():
                flat = turn.reshape(*turn.shape[:-2], 9)
                unskinned = unskinned + _combine(flat, self.pose_basis[9 * j : 9 * j + 9])
        posed = unskinned
        for j, turn in turns.items():
            arm = unskinned - joints[..., j : j + 1, :]
            posed = posed + self.skin_weights[:, j : j + 1] * (arm @ turn.swapaxes(-1, -2))
        return posed

    def skin_transform(
        self,
        expr: Array,
        *,
        eye_rot: Array | None = None,
        neck_rot: Array | None = None,
        jaw_rot: Array | None = None,
    ) -> Array:
        """[..., V, 3, 3] what `pose` multiplies a displacement of each vertex by: I + sum_j w_j (R_j - I)."""
        turns = self._turns(expr, eyes=eye_rot, neck=neck_rot, jaw=jaw_rot)
        transform = identity_like(self.neutral) + 0 * self.neutral[:, :, None]
        for j, turn in turns.items():
            transform = transform + self.skin_weights[:, j, None, None] * turn[..., None, :, :]
        return transform

    def _turns(self, expr: Array, **rotations: Array | None) -> dict[int, Array]:
        """[..., 3, 3] R - I of each joint that turns, by its number; `rotations` by what drives it."""
        rotations["expr"] = None if self.expr_rotation is None else expr @ self.expr_rotation
        turns = {}
        for j, driver in enumerate(self.joint_drivers):
            if rotations[driver] is not None:
                rotmat = axis_angle_to_rotmat(rotations[driver])
                turns[j] = rotmat - identity_like(rotmat)
        return turns

    def map(self, function: Callable[[Array], Array]) -> Subject:
        """The same subject with `function` applied to every array, e.g. to make torch tensors of them."""
        return _map_arrays(self, function)

    def resample(self, vertices: np.ndarray, bary: np.ndarray) -> Subject:
        """The subject on P points, each a barycentric mixture of three vertices. See `HeadRig.resample`."""
        return replace(
            self,
            neutral=_mix(self.neutral, vertices, bary),
            expression_basis=_mix(self.expression_basis, vertices, bary),
            skin_weights=_mix(self.skin_weights, vertices, bary),
            pose_basis=None if self.pose_basis is None else _mix(self.pose_basis, vertices, bary),
            pose_offset=None if self.pose_offset is None else _mix(self.pose_offset, vertices, bary),
        )


@dataclass(frozen=True, eq=False)
class HeadRig:
    """A head model: everything about it that does not depend on a person.

    Rig axes (x to the person's left, y up, face to +z), metres; V vertices, F triangles, S identity modes, E
    expressions, J joints. Arrays are float32 and int32 unless a caller maps them to something else.

    Args:
        name: e.g. `flame2023_no_jaw`, `ict_facekit_light`, `builtin`.
        licence: SPDX-like tag of what the rig was made from.
        template: [V, 3].
        faces: [F, 3].
        uvs, uv_faces: [T, 2] in [0, 1], v up, and [F, 3] into them.
        identity_basis: [S, V, 3].
        expression_basis: [E, V, 3].
        expression_names: E names (ARKit's where the rig has them).
        expression_range: [E, 2] useful values.
        joint_names, joint_drivers: J names and what turns them.
        joints, joints_identity, joints_expression: [J, 3], [S, J, 3], [E, J, 3].
        skin_weights: [V, J].
        expr_rotation, pose_basis, pose_offset: See `Subject`.
        mouth: Placement of a rigid mouth cavity, or None.
        colors: [V, 3] sRGB albedo in [0, 1], or None.
        regions: Named vertex sets: `head` (all but the lower neck) and `deformable` always; others as the
            rig has them (`eyes`, `teeth`, `mouth`, `scalp`, ...).
    """

    name: str
    licence: str
    template: Array
    faces: Array
    uvs: Array
    uv_faces: Array
    identity_basis: Array
    expression_basis: Array
    expression_names: tuple[str, ...]
    expression_range: Array
    joint_names: tuple[str, ...]
    joint_drivers: tuple[str, ...]
    joints: Array
    joints_identity: Array
    joints_expression: Array
    skin_weights: Array
    expr_rotation: Array | None = None
    pose_basis: Array | None = None
    pose_offset: Array | None = None
    mouth: MouthPlacement | None = None
    colors: Array | None = None
    regions: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def n_identity(self) -> int:
        return len(self.identity_basis)

    @property
    def n_expressions(self) -> int:
        return len(self.expression_basis)

    def subject(self, shape: Array | None = None) -> Subject:
        """Bakes identity `shape` [S] (zeros when None; a shorter vector is padded) into the rig."""
        shape = _padded(shape, self.identity_basis)
        neutral = self.template + _combine(shape, self.identity_basis)
        if self.mouth is not None:
            neutral = neutral * (1 - self.mouth.local[..., 3:]) + self.mouth.place(shape)
        return Subject(
            rig_name=self.name,
            expression_names=self.expression_names,
            neutral=neutral,
            expression_basis=self.expression_basis,
            joint_drivers=self.joint_drivers,
            joints=self.joints + _combine(shape, self.joints_identity),
            joints_expression=self.joints_expression,
            skin_weights=self.skin_weights,
            expr_rotation=self.expr_rotation,
            pose_basis=self.pose_basis,
            pose_offset=self.pose_offset,
        )

    def resample(self, vertices: np.ndarray, bary: np.ndarray) -> HeadRig:
        """The rig on P points that are barycentric mixtures of its vertices.

        Blendshapes are linear, so they commute with mixing exactly; skinning does where the three vertices
        share their weights, and elsewhere uses the mixed weights (as in a refined mesh).

        Args:
            vertices: int[P, 3] vertex ids.
            bary: float[P, 3] weights that sum to 1.
        Returns:
            A rig of P vertices and no faces.
        """
        mouth = self.mouth
        if mouth is not None:
            mouth = replace(mouth, local=_mix(mouth.local, vertices, bary))
        return replace(
            self,
            template=_mix(self.template, vertices, bary),
            identity_basis=_mix(self.identity_basis, vertices, bary),
            expression_basis=_mix(self.expression_basis, vertices, bary),
            skin_weights=_mix(self.skin_weights, vertices, bary),
            pose_basis=None if self.pose_basis is None else _mix(self.pose_basis, vertices, bary),
            pose_offset=None if self.pose_offset is None else _mix(self.pose_offset, vertices, bary),
            colors=None if self.colors is None else _mix(self.colors, vertices, bary),
            mouth=mouth,
            faces=self.faces[:0],
            uv_faces=self.uv_faces[:0],
            regions={},
        )

    def map(self, function: Callable[[Array], Array]) -> HeadRig:
        """The same rig with `function` applied to every array of the model (faces, UVs, regions stay)."""
        keep = {"faces", "uvs", "uv_faces", "regions", "expression_range"}
        mouth = None if self.mouth is None else _map_arrays(self.mouth, function)
        return replace(_map_arrays(self, function, keep | {"mouth"}), mouth=mouth)


def _map_arrays(thing, function, keep: frozenset | set = frozenset()):
    changes = {}
    for f in fields(thing):
        value = getattr(thing, f.name)
        if f.name not in keep and hasattr(value, "shape"):
            changes[f.name] = function(value)
    return replace(thing, **changes)


def _combine(coefficients: Array, basis: Array) -> Array:
    """[..., K] and [K, ...shape] -> [..., *shape]: the linear part of every blendshape model."""
    flat = coefficients @ basis.reshape(basis.shape[0], -1)
    return flat.reshape(*coefficients.shape[:-1], *basis.shape[1:])


def _mix(values: Array, vertices: np.ndarray, bary: np.ndarray) -> Array:
    """[..., V, C] -> [..., P, C] barycentric mixture, in the dtype of `values`."""
    weights = np.asarray(bary)
    mixed = 0
    for corner in range(3):
        weight = weights[:, corner, None]
        weight = weight.astype(values.dtype) if isinstance(values, np.ndarray) else values.new_tensor(weight)
        mixed = mixed + values[..., vertices[:, corner], :] * weight
    return mixed


def _padded(shape: Array | None, basis: Array) -> Array:
    n = basis.shape[0]
    if shape is None:
        return 0 * basis[:, 0, 0]
    if len(shape) >= n:
        return shape[:n]
    xp = namespace(shape)
    return xp.concatenate([shape, 0 * basis[len(shape) :, 0, 0]])


def _cross(a: Array, b: Array) -> Array:
    xp = namespace(a)
    return xp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
