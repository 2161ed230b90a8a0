"""What mouse and keyboard do to the view."""

import pytest
from cap4d.app.controls import MAX_SCROLL, Controls, Drag
from cap4d.app.orbit import Orbit

HOME = Orbit(0, 0, 1, (0, 0, 0), 20)


@pytest.fixture
def controls():
    return Controls(lambda: HOME)


def test_moving_without_a_button_leaves_the_camera_to_its_path(controls):
    controls.move(10, 10, (400, 200))
    assert controls.orbit is None


def test_a_drag_turns_by_what_the_pointer_moved_since_the_press(controls):
    controls.move(100, 100, (400, 200))
    controls.press(Drag.TURN)
    controls.move(120, 100, (400, 200))
    controls.release()
    controls.move(300, 100, (400, 200))
    assert controls.orbit == HOME.turned(0.1, 0)


def test_a_pan_drag_moves_the_target(controls):
    controls.press(Drag.PAN)
    controls.move(0, 20, (400, 200))
    assert controls.orbit == HOME.panned(0, 0.1)


def test_the_wheel_zooms_and_a_trackpad_in_parts(controls):
    controls.scroll(2)
    assert controls.orbit == HOME.zoomed(2)
    for _ in range(8):
        controls.scroll(-0.25)
    assert controls.orbit.distance == pytest.approx(HOME.distance)


def test_no_event_zooms_without_limit(controls):
    controls.scroll(1e9)
    assert controls.orbit == HOME.zoomed(MAX_SCROLL)


def test_two_fingers_pan(controls):
    controls.pan(20, 10, (400, 200))
    assert controls.orbit == HOME.panned(0.1, 0.05)


def test_a_window_without_pixels_divides_by_nothing(controls):
    controls.press(Drag.TURN)
    controls.move(1, 1, (0, 0))
    controls.pan(1, 1, (0, 0))
    assert controls.orbit is not None


def test_reset_gives_the_camera_back_to_its_path(controls):
    controls.scroll(2)
    controls.reset()
    assert controls.orbit is None
