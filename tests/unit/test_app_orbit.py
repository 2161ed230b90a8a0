"""The viewer's camera maths."""

import numpy as np
import pytest
from cap4d.app.orbit import DISTANCE_RANGE, MAX_PITCH_DEG, Orbit

from cap4d.camera import orbit_camera

VIEW = Orbit(yaw_deg=20, pitch_deg=10, distance=0.8, target=(0.01, -0.02, 0.03), fov_deg=24)


@pytest.mark.parametrize(("yaw", "pitch"), [(0, 0), (35, -20), (-120, 60), (179, 5)])
def test_an_orbit_starts_at_the_camera_it_is_made_from(yaw, pitch):
    target = np.array([0.02, -0.01, 0.05])
    size = {"width": 640, "height": 480}
    camera = orbit_camera(yaw_deg=yaw, pitch_deg=pitch, distance=0.7, target=target, fov_y_deg=20, **size)
    orbit = Orbit.from_camera(camera, target)
    again = orbit.camera(640, 480)
    np.testing.assert_allclose(again.viewmat, camera.viewmat, atol=1e-9)
    np.testing.assert_allclose(again.K, camera.K, rtol=1e-9)
    assert (orbit.yaw_deg, orbit.pitch_deg, orbit.distance) == pytest.approx((yaw, pitch, 0.7))


def test_the_target_is_on_the_axis_next_to_the_centre():
    size = {"width": 100, "height": 100}
    camera = orbit_camera(yaw_deg=0, pitch_deg=0, distance=1, target=np.zeros(3), fov_y_deg=20, **size)
    orbit = Orbit.from_camera(camera, np.array([0.1, 0.05, 0.2]))
    assert orbit.target == pytest.approx((0, 0, 0.2))
    assert orbit.distance == pytest.approx(1.2)


@pytest.mark.parametrize("size", [(300, 900), (900, 300), (1, 1)])
def test_the_shorter_side_keeps_its_field_of_view(size):
    camera = VIEW.camera(*size)
    side = min(size)
    assert 2 * np.degrees(np.arctan(0.5 * side / camera.K[0, 0])) == pytest.approx(24)
    assert camera.K[0, 0] == camera.K[1, 1]


def test_dragging_right_turns_the_front_of_the_head_right():
    front = np.array([0.01, -0.02, -0.07])  # nearer to the camera than the target
    frontal = Orbit(0, 0, 0.8, (0.01, -0.02, 0.03), 24)
    before = frontal.camera(500, 500).project(front)
    after = frontal.turned(0.1, 0).camera(500, 500).project(front)
    assert after[0] > before[0] + 5
    assert frontal.turned(0, 0.1).camera(500, 500).project(front)[1] > before[1] + 5


def test_the_pitch_stops_before_the_poles_and_the_yaw_goes_round():
    assert VIEW.turned(0, 5).pitch_deg == MAX_PITCH_DEG
    assert VIEW.turned(0, -5).pitch_deg == -MAX_PITCH_DEG
    assert VIEW.turned(2, 0).yaw_deg == pytest.approx(20)


def test_zooming_there_and_back_is_nothing_and_has_ends():
    assert VIEW.zoomed(3).zoomed(-3).distance == pytest.approx(0.8)
    assert VIEW.zoomed(1).distance < 0.8
    assert (VIEW.zoomed(1000).distance, VIEW.zoomed(-1000).distance) == DISTANCE_RANGE


def test_a_panned_target_follows_the_pointer():
    target = np.array(VIEW.target)
    before = VIEW.camera(600, 400).project(target)
    after = VIEW.panned(0.25, -0.1).camera(600, 400).project(target)
    np.testing.assert_allclose(after[:2] - before[:2], [100, -40], atol=1e-6)
