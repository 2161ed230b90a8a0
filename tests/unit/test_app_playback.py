"""Clips that are steered and streams that are not, on a clock of our own."""

from dataclasses import replace

import numpy as np
import pytest
from cap4d.app.playback import SPEEDS, ClipPlayback, StreamPlayback
from tiny_bundle import tiny_clip

from cap4d.drive.sample import sample

CLIP = replace(tiny_clip(12), fps=10.0)


@pytest.fixture
def playback():
    return ClipPlayback(CLIP, 0.0)


def shown(playback, now):
    """The expression shown at `now`."""
    playback.number(now)
    return playback.frame().expr


def test_it_plays_the_clip_again_and_again(playback):
    assert [playback.number(t) for t in (0.0, 0.1, 1.2)] == [0, 1, 12]
    np.testing.assert_array_equal(playback.frame().expr, CLIP.expr[0])
    assert playback.position == pytest.approx(0)


def test_without_repeat_it_stops_on_the_last_frame_and_plays_again_from_the_first(playback):
    playback.set_loops(False, 0.0)
    np.testing.assert_array_equal(shown(playback, 5.0), CLIP.expr[-1])
    assert playback.is_paused
    assert playback.due() == float("inf")
    assert playback.position == pytest.approx(1.1)
    playback.toggle(6.0)
    np.testing.assert_array_equal(shown(playback, 6.1), CLIP.expr[1])


def test_repeat_is_turned_off_in_a_later_round_and_that_round_plays_to_its_end(playback):
    playback.number(2.7)
    moves = playback.moves
    playback.set_loops(False, 2.7)
    np.testing.assert_array_equal(shown(playback, 2.8), CLIP.expr[4])
    assert not playback.is_paused
    assert playback.moves > moves  # a sound beside it goes there, too
    np.testing.assert_array_equal(shown(playback, 9.0), CLIP.expr[-1])
    assert playback.is_paused


def test_a_pause_holds(playback):
    playback.number(0.3)
    playback.toggle(0.3)
    assert playback.number(9.0) == 3
    playback.toggle(9.0)
    assert playback.number(9.1) == 4


def test_steps_go_round_the_ends_of_a_clip_that_repeats(playback):
    playback.number(0.0)
    playback.step(-1, 0.0)
    np.testing.assert_array_equal(shown(playback, 1.0), CLIP.expr[11])
    playback.step(2, 1.0)
    np.testing.assert_array_equal(shown(playback, 2.0), CLIP.expr[1])
    playback.set_loops(False, 2.0)
    playback.step(-5, 2.0)
    np.testing.assert_array_equal(shown(playback, 3.0), CLIP.expr[0])


@pytest.mark.parametrize("seconds", [0.0, 0.5, 1.1])
@pytest.mark.parametrize("smooth", [False, True])
def test_seeking_shows_that_moment(playback, seconds, smooth):
    playback.set_smooth(60.0 if smooth else None, 0.0)
    playback.number(0.7)
    playback.seek(seconds, 0.7)
    np.testing.assert_allclose(shown(playback, 0.7), CLIP.expr[round(10 * seconds)], atol=1e-6)
    assert playback.position == pytest.approx(seconds, abs=1e-6)


def test_seeking_stays_within_the_clip(playback):
    playback.seek(99.0, 0.0)
    assert playback.position == pytest.approx(1.1)
    playback.seek(-1.0, 0.0)
    assert playback.position == 0


def test_speed_keeps_the_place(playback):
    playback.number(0.5)
    playback.set_speed(0.5, 0.5)
    assert playback.position == pytest.approx(0.5)
    assert [playback.number(t) for t in (0.6, 0.7)] == [5, 6]
    playback.set_speed(100.0, 0.7)
    assert playback.speed == SPEEDS[-1]


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_smooth_motion_comes_at_the_displays_rate_between_the_frames(playback, speed):
    playback.set_smooth(60.0, 0.0)
    playback.set_speed(speed, 0.0)
    assert [playback.number(i / 60 + 1e-4) for i in range(4)] == [0, 1, 2, 3]
    np.testing.assert_allclose(playback.frame().expr, sample(CLIP, 3 * speed / 60).expr, atol=1e-6)
    assert playback.interval == pytest.approx(1 / 60)
    playback.set_smooth(None, 0.1)
    assert not playback.is_smooth
    assert playback.interval == pytest.approx(0.1 / speed)


def test_skipped_frames_are_counted(playback):
    playback.number(0.0)
    playback.number(0.5)
    assert playback.dropped == 4


class Stream:
    """A live stream that shows what the test put into it."""

    state, address, error = "playing", "tcp://127.0.0.1:9000", None

    def __init__(self, frame):
        self.now_shown, self.seen, self.runs = frame, [], False

    def __enter__(self):
        self.runs = True
        return self

    def __exit__(self, *_):
        assert self.runs
        self.runs = False

    def frame(self, now):
        return self.now_shown

    def shown(self, now):
        self.seen.append(now)

    def statistics(self):
        return {"dropped": 3, "late": 1}


def test_a_stream_is_looked_at_often_and_drawn_only_when_it_changes():
    stream = Stream(CLIP.frame(0))
    playback = StreamPlayback(stream, rig_name="tiny", display_hz=50)
    first = playback.number(1.0)
    assert playback.due() == pytest.approx(1.02)
    stream.now_shown = replace(CLIP.frame(0), t=7.0)
    assert playback.number(1.1) == first
    assert playback.frame().t == 7.0
    stream.now_shown = CLIP.frame(1)
    assert playback.number(1.2) != first
    stream.now_shown = replace(CLIP.frame(1), rot=np.ones(3, np.float32))
    assert playback.number(1.3) == first + 2


def test_a_stream_hears_when_its_frame_is_on_screen_and_ends_with_the_playback():
    stream = Stream(CLIP.frame(0))
    playback = StreamPlayback(stream, rig_name="tiny")
    assert stream.runs
    assert playback.name == "tcp://127.0.0.1:9000"
    playback.shown(2.0)
    playback.close()
    playback.close()
    assert (stream.seen, stream.runs, playback.is_closed) == ([2.0], False, True)
    assert playback.dropped == 3
    assert playback.state == "playing"
