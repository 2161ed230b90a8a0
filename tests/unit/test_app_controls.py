"""Mouse and keyboard, without a window."""

import pytest
from cap4d.app.controls import Controls, Drag
from cap4d.app.orbit import Orbit
from cap4d.app.play_clock import PlayClock

HOME = Orbit(0, 0, 1, (0, 0, 0), 20)


@pytest.fixture
def controls():
    return Controls(PlayClock(25, 0.0), lambda: HOME)


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


def test_the_wheel_zooms(controls):
    controls.scroll(2)
    assert controls.orbit == HOME.zoomed(2)


def test_reset_gives_the_camera_back_to_its_path_and_rewinds(controls):
    controls.scroll(2)
    controls.clock.index(1.0)
    controls.key("r", 1.0)
    assert controls.orbit is None
    assert controls.clock.index(1.0) == 0


def test_keys(controls):
    controls.clock.index(0.4)
    controls.key("space", 0.4)
    assert controls.clock.paused
    controls.key("right", 0.5)
    assert controls.clock.index(0.5) == 11
    controls.key("left", 0.5)
    assert controls.clock.index(0.5) == 10
    controls.key("h", 0.5)
    assert not controls.shows_hud
    controls.key("x", 0.5)
    assert not controls.quit
    controls.key("escape", 0.5)
    assert controls.quit
