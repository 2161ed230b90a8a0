"""Rotations as axis-angle, matrix and quaternion (wxyz). One set of functions for NumPy and torch."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np

Array = Any  # np.ndarray or torch.Tensor

RODRIGUES_MIN_ANGLE2 = 1e-8  # rad^2; below it the axis is the vector over 1e-4 (fact 9)


def namespace(x: Array) -> ModuleType:
    """The module whose functions work on `x`: torch for a tensor, NumPy otherwise. Never imports torch."""
    torch = sys.modules.get("torch")
    return torch if torch is not None and isinstance(x, torch.Tensor) else np


def axis_angle_to_rotmat(rotvec: Array) -> Array:
    """Rodrigues' formula, with the angle kept away from zero so that gradients stay finite (fact 9).

    Args:
        rotvec: [..., 3] axis times angle, rad.
    Returns:
        [..., 3, 3] rotation matrices.
    """
    xp = namespace(rotvec)
    angle2 = (rotvec * rotvec).sum(-1)
    angle = xp.sqrt(xp.clip(angle2, RODRIGUES_MIN_ANGLE2, None))[..., None]
    k = skew(rotvec / angle)
    sin, cos = xp.sin(angle)[..., None], xp.cos(angle)[..., None]
    return identity_like(k) + sin * k + (1 - cos) * (k @ k)


def rotmat_to_axis_angle(rotmat: Array) -> Array:
    """The rotation vector of each matrix, through the quaternion, accurate near 0 and near pi.

    Args:
        rotmat: [..., 3, 3].
    Returns:
        [..., 3] rad, angle in [0, pi].
    """
    xp = namespace(rotmat)
    quat = rotmat_to_quat(rotmat)
    w, v = quat[..., :1], quat[..., 1:]
    sign = xp.where(w < 0, -xp.ones_like(w), xp.ones_like(w))
    w, v = w * sign, v * sign
    sin_half = xp.sqrt(xp.clip((v * v).sum(-1)[..., None], 1e-30, None))
    angle = 2 * xp.arctan2(sin_half, w)
    small = sin_half < 1e-7
    return v * xp.where(small, 2 * xp.ones_like(w), angle / xp.where(small, xp.ones_like(w), sin_half))


def skew(v: Array) -> Array:
    """[..., 3] -> [..., 3, 3], the matrix of the cross product with v."""
    xp = namespace(v)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = xp.zeros_like(x)
    rows = [xp.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])]
    return xp.stack(rows, -2)


def identity_like(matrix: Array) -> Array:
    """[3, 3] identity of the dtype (and device) of `matrix`."""
    xp = namespace(matrix)
    if xp is np:
        return np.eye(3, dtype=matrix.dtype)
    return xp.eye(3, dtype=matrix.dtype, device=matrix.device)


def quat_to_rotmat(quat: Array) -> Array:
    """[..., 4] wxyz, any non-zero norm -> [..., 3, 3]. A zero quaternion gives the identity."""
    xp = namespace(quat)
    largest = xp.amax(abs(quat), -1)[..., None]
    quat = quat / xp.where(largest > 0, largest, xp.ones_like(largest))  # its square may not be a number
    norm2 = (quat * quat).sum(-1)
    s = 2 / xp.where(norm2 > 0, norm2, xp.ones_like(norm2))
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def rotmat_to_quat(rotmat: Array) -> Array:
    """[..., 3, 3] -> [..., 4] unit wxyz; the best conditioned of Shepperd's four forms per matrix."""
    xp = namespace(rotmat)
    m = [[rotmat[..., i, j] for j in range(3)] for i in range(3)]
    trace = m[0][0] + m[1][1] + m[2][2]
    forms = xp.stack(
        [
            xp.stack([1 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]], -1),
            xp.stack([m[2][1] - m[1][2], 1 + 2 * m[0][0] - trace, m[0][1] + m[1][0], m[0][2] + m[2][0]], -1),
            xp.stack([m[0][2] - m[2][0], m[0][1] + m[1][0], 1 + 2 * m[1][1] - trace, m[1][2] + m[2][1]], -1),
            xp.stack([m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1 + 2 * m[2][2] - trace], -1),
        ],
        -2,
    )
    best = xp.stack([trace, m[0][0], m[1][1], m[2][2]], -1).argmax(-1)
    picked = (forms * (best[..., None] == _arange(xp, 4, forms))[..., None]).sum(-2)
    return picked / xp.sqrt((picked * picked).sum(-1))[..., None]


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product of [..., 4] wxyz quaternions: the rotation b, then a."""
    xp = namespace(a)
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return xp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def _arange(xp: ModuleType, n: int, like: Array) -> Array:
    return np.arange(n) if xp is np else xp.arange(n, device=like.device)
