"""Rotations near the identity, near pi, and of any norm; NumPy and torch give the same."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d.rotation import (
    axis_angle_to_rotmat,
    quat_multiply,
    quat_to_rotmat,
    rotmat_to_axis_angle,
    rotmat_to_quat,
)

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.3, 3.0, np.pi - 1e-6, np.pi]


def random_axes(n: int) -> np.ndarray:
    axes = np.random.default_rng(0).normal(size=(n, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_round_trip_through_matrix_and_quaternion(angle: float) -> None:
    rotvec = random_axes(50) * angle
    rotmat = axis_angle_to_rotmat(rotvec)
    np.testing.assert_allclose(
        rotmat @ rotmat.swapaxes(1, 2), np.broadcast_to(np.eye(3), rotmat.shape), atol=1e-7
    )
    np.testing.assert_allclose(quat_to_rotmat(rotmat_to_quat(rotmat)), rotmat, atol=1e-7)
    # compared as rotations: at pi an axis and its opposite are the same
    np.testing.assert_allclose(axis_angle_to_rotmat(rotmat_to_axis_angle(rotmat)), rotmat, atol=1e-6)


def test_product_of_quaternions_is_product_of_matrices() -> None:
    a, b = (np.random.default_rng(s).normal(size=(20, 4)) for s in (1, 2))
    np.testing.assert_allclose(
        quat_to_rotmat(quat_multiply(a, b)), quat_to_rotmat(a) @ quat_to_rotmat(b), atol=1e-12
    )


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e30])
def test_quaternion_of_any_norm_stays_finite(scale: float) -> None:
    assert np.isfinite(quat_to_rotmat(np.array([[0.3, -0.2, 0.5, 0.1]]) * scale)).all()


def test_torch_agrees_and_its_gradient_is_finite_at_zero() -> None:
    torch = pytest.importorskip("torch")
    rotvec = torch.tensor(np.concatenate([random_axes(4), np.zeros((1, 3))]), requires_grad=True)
    rotmat = axis_angle_to_rotmat(rotvec)
    np.testing.assert_allclose(
        rotmat.detach().numpy(), axis_angle_to_rotmat(rotvec.detach().numpy()), atol=1e-12
    )
    rotmat.sum().backward()
    assert torch.isfinite(rotvec.grad).all()
    np.testing.assert_allclose(
        rotmat_to_quat(rotmat.detach()).numpy(), rotmat_to_quat(rotmat.detach().numpy()), atol=1e-12
    )
