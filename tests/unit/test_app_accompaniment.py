"""A sound that does what the clip does, and rules its clock."""

from dataclasses import replace

import numpy as np
import pytest
from cap4d.app.accompaniment import Accompaniment
from cap4d.app.playback import ClipPlayback, StreamPlayback
from cap4d.app.sound import SoundPlayer
from stepped_clock import SteppedClock
from test_app_playback import Stream
from tiny_bundle import tiny_clip

from cap4d.player.sound import Sound

CLIP = replace(tiny_clip(20), fps=10.0)


@pytest.fixture
def stage():
    """A clip, a silent player on a clock of our own, and the accompaniment between them."""
    clock = SteppedClock(0.0)
    player = SoundPlayer(Sound(np.zeros((16_000, 1), np.int16), 8_000), None, clock=clock)
    return clock, ClipPlayback(CLIP, 0.0), Accompaniment(player)


def run(stage, until, step=0.05):
    clock, playback, accompaniment = stage
    while clock.now < until - 1e-9:
        clock.now += step
        accompaniment.follow(playback, clock.now)
        playback.number(clock.now)


def test_both_play_together_through_the_clips_end(stage):
    _, playback, accompaniment = stage
    run(stage, 2.5)
    assert accompaniment.player.loop == pytest.approx(2.0)
    assert playback.number(2.5) == int(10 * accompaniment.player.position() + 1e-6)
    assert playback.position == pytest.approx(0.5, abs=0.11)


def test_the_sounds_clock_rules(stage):
    clock, playback, accompaniment = stage
    run(stage, 0.5)
    accompaniment.player.seek(1.5)  # as a device would that had run ahead
    accompaniment.follow(playback, clock.now)
    assert playback.number(clock.now) == 15


def test_a_pause_and_a_jump_of_the_clip_are_the_sounds_too(stage):
    clock, playback, accompaniment = stage
    run(stage, 0.5)
    playback.toggle(clock.now)
    run(stage, 1.0)
    assert not accompaniment.player.playing
    playback.seek(1.2, clock.now)
    playback.toggle(clock.now)
    run(stage, 1.3)
    assert accompaniment.player.playing
    assert accompaniment.player.position() == pytest.approx(playback.position, abs=0.11)
    assert playback.position == pytest.approx(1.5, abs=0.11)


def test_speed_is_followed_and_a_clip_that_stops_stops_the_sound(stage):
    clock, playback, accompaniment = stage
    run(stage, 0.1)
    playback.set_speed(2.0, clock.now)
    playback.set_loops(False, clock.now)
    run(stage, 0.5)
    assert accompaniment.player.speed == 2
    assert playback.position == pytest.approx(0.9, abs=0.21)  # heard a step of ours late
    run(stage, 2.0)
    assert playback.is_paused
    assert not accompaniment.player.playing
    assert accompaniment.player.loop is None


def test_another_clip_starts_the_sound_over(stage):
    clock, _, accompaniment = stage
    run(stage, 0.9)
    another = ClipPlayback(CLIP, clock.now)
    accompaniment.follow(another, clock.now)
    assert accompaniment.player.position() == 0


def test_beside_a_live_stream_it_just_plays(stage):
    clock, _, accompaniment = stage
    accompaniment.follow(StreamPlayback(Stream(CLIP.frame(0)), rig_name="tiny"), 0.0)
    clock.now = 1.0
    assert accompaniment.player.position() == pytest.approx(1.0)
    accompaniment.close()
    assert not accompaniment.player.playing
