"""Cameras: projection, cropping, orbits, and the fold of the head's pose."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d import ArgumentError, Camera
from cap4d.camera import head_fixed, is_rigid, opencv_from_rig, orbit_camera
from cap4d.rotation import axis_angle_to_rotmat

ORBIT = dict(distance=1.0, target=np.array([0.0, 0.02, 0.0]), fov_y_deg=20.0, width=200, height=100)


def test_crop_and_resize_keep_what_a_pixel_sees() -> None:
    camera = orbit_camera(yaw_deg=20, pitch_deg=10, **ORBIT)
    points = np.random.default_rng(0).normal(scale=0.1, size=(10, 3))
    pixels = camera.project(points)
    np.testing.assert_allclose(
        camera.cropped(30, -5, 50, 60).project(points)[:, :2], pixels[:, :2] - [30, -5]
    )
    np.testing.assert_allclose(camera.resized(400, 50).project(points)[:, :2], pixels[:, :2] * [2, 0.5])


@pytest.mark.parametrize("pitch", [-90, -30, 0, 45, 90])
def test_orbit_looks_at_its_target_from_the_right_side(pitch: float) -> None:
    camera = orbit_camera(yaw_deg=90, pitch_deg=pitch, **ORBIT)
    np.testing.assert_allclose(camera.project(ORBIT["target"]), [100, 50, 1.0], atol=1e-9)
    assert np.sign(round(camera.position[1] - 0.02, 9)) == -np.sign(pitch)  # from above is -y
    np.testing.assert_allclose(np.linalg.det(camera.viewmat[:3, :3]), 1, atol=1e-12)


def test_frontal_orbit_sees_the_face_upright() -> None:
    camera = orbit_camera(yaw_deg=0, pitch_deg=0, **ORBIT)
    nose, top, left_ear = opencv_from_rig(np.array([[0, 0, 0.1], [0, 0.1, 0], [0.1, 0, 0]]))
    assert camera.project(nose)[2] < 1.0
    assert camera.project(top)[1] < 50 - 0
    assert camera.project(left_ear)[0] > 100  # the person's left is on the image's right


def test_head_fixed_sees_the_same_picture() -> None:
    rng = np.random.default_rng(1)
    points, rot, tra = rng.normal(scale=0.1, size=(20, 3)), rng.normal(size=3), np.array([0.1, -0.05, -1.2])
    world = opencv_from_rig(points @ axis_angle_to_rotmat(rot).T + tra)
    K = np.array([[1000, 0, 256], [0, 1000, 256], [0, 0, 1.0]])
    moved = Camera(K, np.eye(4), 512, 512).project(world)
    fixed = Camera(K, head_fixed(np.eye(4), rot, tra), 512, 512).project(opencv_from_rig(points))
    np.testing.assert_allclose(fixed, moved, atol=1e-9)


def test_bad_cameras_are_refused() -> None:
    with pytest.raises(ArgumentError, match="K: expected"):
        Camera(np.full((3, 3), np.nan), np.eye(4), 4, 4)
    with pytest.raises(ArgumentError, match="size: expected"):
        Camera(np.eye(3), np.eye(4), 0, 4)


def test_only_rotations_with_translations_are_rigid() -> None:
    sound = orbit_camera(yaw_deg=40, pitch_deg=-20, **ORBIT).viewmat
    assert is_rigid(sound) and is_rigid(sound.astype(np.float32))
    mirror, scaled, far, row = np.diag([-1.0, 1, 1, 1]), 1.01 * sound, sound.copy(), sound.copy()
    scaled[3], far[0, 3], row[3, 0] = [0, 0, 0, 1], 1e5, 0.1
    for bad in (mirror, scaled, far, row, 0 * sound, np.full((4, 4), np.nan), np.full((4, 4), 1e300)):
        assert not is_rigid(bad)
