"""The clip on the wall clock."""

import pytest
from cap4d.app.play_clock import PlayClock


def test_frames_follow_the_clock():
    clock = PlayClock(25, 100.0)
    assert [clock.index(100 + t) for t in (0, 0.039, 0.04, 0.081, 0.12)] == [0, 0, 1, 2, 3]
    assert clock.dropped == 0
    assert clock.due() == pytest.approx(100.16)


def test_a_slow_player_skips_frames_and_counts_them():
    clock = PlayClock(25, 0.0)
    assert [clock.index(t) for t in (0.0, 0.2, 0.4)] == [0, 5, 10]
    assert clock.dropped == 8


def test_a_pause_holds_the_frame_and_goes_on_from_it():
    clock = PlayClock(10, 0.0)
    clock.index(0.5)
    clock.toggle(0.5)
    dropped = clock.dropped
    assert clock.index(7.0) == 5
    assert clock.due() == float("inf")
    clock.toggle(7.0)
    assert [clock.index(t) for t in (7.0, 7.1)] == [5, 6]
    assert clock.dropped == dropped


def test_speed_changes_how_fast_frames_come_and_not_which_is_shown():
    clock = PlayClock(10, 0.0)
    clock.index(1.0)
    clock.change_speed(0.5, 1.0)
    assert [clock.index(t) for t in (1.0, 1.1, 1.2, 1.4)] == [10, 10, 11, 12]
    assert clock.due() == pytest.approx(1.6)


def test_seeking_plays_on_from_there():
    clock = PlayClock(10, 0.0)
    clock.index(2.0)
    clock.seek(3, 2.0)
    assert [clock.index(t) for t in (2.0, 2.1)] == [3, 4]
    clock.seek(-5, 3.0)
    assert clock.index(3.0) == 0


def test_it_follows_another_clock():
    clock = PlayClock(10, 0.0, speed=2.0)
    clock.index(0.0)
    clock.follow(1.0, 5.0)
    assert clock.index(5.0) == 10
