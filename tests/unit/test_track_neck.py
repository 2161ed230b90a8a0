"""The shoulders stay where they are while the head moves over them."""

import numpy as np
import pytest

from cap4d.rotation import axis_angle_to_rotmat

for module in ("OpenImageIO", "torch", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from cap4d.track.neck import mean_rotation, nearest_rotation, steady_neck  # noqa: E402


def _shoulders(rig, rot, tra, neck):
    chosen = rig.skin_weights[:, rig.joint_names.index("neck")] > 0.99
    head = rig.subject().pose(np.zeros(rig.n_expressions, np.float32), neck_rot=np.float32(neck))[chosen]
    return head @ axis_angle_to_rotmat(rot).T + tra


def test_shoulders_stand_still_under_a_nodding_and_turning_head(builtin_rig):
    t = np.linspace(0, 2 * np.pi, 9)
    rot = np.stack([0.15 * np.sin(t), 0.3 * np.cos(t), 0.05 * np.sin(2 * t)], 1)
    pivot = builtin_rig.joints[builtin_rig.joint_names.index("neck")].astype(float)
    tra = np.array([0.0, 0.0, -1.0]) + pivot - np.einsum("tij,j->ti", axis_angle_to_rotmat(rot), pivot)
    neck = steady_neck(builtin_rig, np.zeros(builtin_rig.n_identity), rot, tra)
    still = np.stack([_shoulders(builtin_rig, rot[i], tra[i], neck[i]) for i in range(len(t))])
    loose = np.stack([_shoulders(builtin_rig, rot[i], tra[i], np.zeros(3)) for i in range(len(t))])
    assert still.std(0).max() < 0.004 < 0.02 < loose.std(0).max()


def test_a_head_at_rest_bends_nothing(builtin_rig):
    rot, tra = np.tile([0.1, 0.2, 0.0], (3, 1)), np.tile([0.0, 0.0, -1.0], (3, 1))
    np.testing.assert_allclose(steady_neck(builtin_rig, np.zeros(1), rot, tra), 0, atol=1e-5)


def test_mean_rotation_of_a_symmetric_pair_is_between():
    pair = axis_angle_to_rotmat(np.array([[0.0, 0.4, 0.0], [0.0, -0.2, 0.0]]))
    np.testing.assert_allclose(
        mean_rotation(pair), axis_angle_to_rotmat(np.array([0.0, 0.1, 0.0])), atol=1e-12
    )


def test_nearest_rotation_is_proper():
    mirrored = np.diag([1.0, 1.0, -1.0])
    assert np.linalg.det(nearest_rotation(mirrored)) == pytest.approx(1)
