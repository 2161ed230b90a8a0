"""Gaussians that ride on triangles: local parameters and a posed mesh to posed Gaussians.

GaussianAvatars (Qian et al. 2024, section 3.1) with the frames of fact 27. One set of functions for
NumPy and torch (which gives gradients), and the C++ form of the same for playing.
"""

from __future__ import annotations

import numpy as np

from cap4d import _core
from cap4d.rotation import Array, namespace, quat_multiply, rotmat_to_quat

SAFE_NORM2 = 1e-20
"""Squared lengths are kept above this: a triangle without area has a finite frame and gradient (fact 27)."""


def triangle_frames(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """A place, a rotation and a size for each triangle.

    Args:
        vertices: [..., G, 3] m.
        faces: int[M, 3].
    Returns:
        centres [..., M, 3] m; rotmats [..., M, 3, 3] with columns first edge, normal, minus normal x edge;
        sizes [..., M] m: the mean of the first edge and the height over it.
    """
    xp = namespace(vertices)
    v0, v1, v2 = (vertices[..., faces[:, i], :] for i in range(3))
    edge, side = v1 - v0, v2 - v0
    a0 = _safe_normalize(edge)
    a1 = _safe_normalize(_cross(a0, side))
    a2 = -_cross(a1, a0)
    sizes = (_safe_norm(edge)[..., 0] + abs((a2 * side).sum(-1))) / 2
    return (v0 + v1 + v2) / 3, xp.stack([a0, a1, a2], -1), sizes


def bind(
    frames: tuple[Array, Array, Array], *, means: Array, quats: Array, log_scales: Array, binding: Array
) -> tuple[Array, Array, Array]:
    """Posed Gaussians from their triangles' frames (fact 27).

    Args:
        frames: centres [..., M, 3], rotmats [..., M, 3, 3], sizes [..., M] of `triangle_frames`.
        means: [N, 3] in units of the triangle's size.
        quats: [N, 4] wxyz, any norm.
        log_scales: [N, 3] logarithm of the scales in units of the triangle's size.
        binding: int[N], the triangle of each Gaussian.
    Returns:
        means [..., N, 3] m, quats [..., N, 4] unit, scales [..., N, 3] m.
    """
    xp = namespace(means)
    centres, rotmats, sizes = frames
    size = sizes[..., binding][..., None]
    posed = (rotmats[..., binding, :, :] @ means[..., None])[..., 0] * size + centres[..., binding, :]
    face_quats = rotmat_to_quat(rotmats)[..., binding, :]
    return posed, quat_multiply(face_quats, quats / _safe_norm(quats)), xp.exp(log_scales) * size


def bind_fast(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    means: np.ndarray,
    quats: np.ndarray,
    log_scales: np.ndarray,
    binding: np.ndarray,
    threads: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`bind(triangle_frames(vertices, faces), ...)` in C++.

    Args:
        vertices: float32[G, 3] m; faces: int32[M, 3].
        means, quats, log_scales, binding: float32[N, 3], float32[N, 4], float32[N, 3], int32[N].
    Returns:
        float32 means [N, 3] m, quats [N, 4], scales [N, 3] m.
    Raises:
        ValueError: A shape does not fit or an index is out of range.
        TypeError: A dtype is not as above.
    """
    return _core.bind(vertices, faces, means, quats, log_scales, binding, threads)


def _cross(a: Array, b: Array) -> Array:
    xp = namespace(a)
    (ax, ay, az), (bx, by, bz) = ([v[..., i] for i in range(3)] for v in (a, b))
    return xp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def _safe_norm(v: Array) -> Array:
    xp = namespace(v)
    return xp.sqrt(xp.clip((v * v).sum(-1), SAFE_NORM2, None))[..., None]


def _safe_normalize(v: Array) -> Array:
    return v / _safe_norm(v)
