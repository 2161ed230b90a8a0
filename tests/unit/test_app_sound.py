"""The audio clock, and the player with a false device and with one that plays to nobody."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from cap4d.app import sound as sound_module
from cap4d.app.sound import MiniaudioDevice, NoDeviceError, SoundPlayer
from cap4d.app.sound_clock import SoundClock
from stepped_clock import SteppedClock

from cap4d.player.sound import Sound

RATE = 8000


class FakeDevice:
    """Asks for a gulp when told to."""

    latency = 0.05

    def __init__(self):
        self.closed = False

    def start(self, fill):
        self.fill = fill

    def close(self):
        self.closed = True


@pytest.fixture
def clock():
    return SteppedClock()


@pytest.fixture
def device():
    return FakeDevice()


def ramp(seconds: float = 1.0) -> Sound:
    """Sample i is i + 1."""
    return Sound(np.arange(1, round(seconds * RATE) + 1, dtype=np.int16)[:, None], RATE)


def run(player, device, clock, seconds, *, gulp=160, speed=1.0, jitter=0.0):
    """Lets the device, whose clock runs at `speed`, ask on time (or late by up to `jitter`) for `seconds`;
    returns its samples and the positions seen meanwhile.
    """
    rng, start, samples, positions = np.random.default_rng(0), clock.now, [], []
    for k in range(round(seconds * speed * RATE / gulp)):
        clock.now = start + k * gulp / RATE / speed + rng.uniform(0, jitter)
        samples.append(device.fill(gulp)[:, 0])
        positions.append((clock.now, player.position()))
    clock.now = start + seconds
    return np.concatenate(samples), np.array(positions)


# The clock


def test_time_goes_on_between_gulps():
    clock = SoundClock(latency=0.1)
    assert clock.heard(0) == 0
    clock.gulp(0.0, 10.0)
    assert clock.heard(10.05) == 0 and clock.heard(10.15) == pytest.approx(0.05)
    clock.gulp(0.2, 10.2)
    assert clock.heard(10.35) == pytest.approx(0.25)


def test_time_never_goes_back_however_late_a_gulp_is():
    clock, seen = SoundClock(latency=0.1), []
    for k, late in enumerate([0, 0.03, -0.01, 0.4, 0.05, 0, 0]):
        clock.gulp(0.1 * k, 0.1 * k + late)
        seen += [clock.heard(0.1 * k + late + dt) for dt in (0, 0.02, 0.04)]
    assert (np.diff(seen) >= 0).all()


def test_drift_is_followed():
    """A device 0.1 % slow: after ten minutes the clock is the device's, not the machine's."""
    clock = SoundClock(latency=0.0)
    for k in range(30_000):
        clock.gulp(k * 0.02, k * 0.02 * 1.001)
    now = 600 * 1.001
    assert clock.heard(now) == pytest.approx(600, abs=0.001)


# The player


def test_nothing_is_heard_before_play(device, clock):
    player = SoundPlayer(ramp(), device, clock=clock)
    samples, positions = run(player, device, clock, 0.2)
    assert not samples.any() and not positions[:, 1].any() and not player.playing and player.heard() is None


def test_samples_follow_one_another_and_the_position_is_what_is_heard(device, clock):
    player = SoundPlayer(ramp(), device, clock=clock)
    player.play()
    samples, positions = run(player, device, clock, 0.5, jitter=0.004)
    assert samples[40:].tolist() == list(range(41, 4001))  # after it has swollen
    assert (np.diff(positions[:, 1]) >= 0).all()
    expected = np.maximum(positions[:, 0] - 100 - device.latency, 0)
    np.testing.assert_allclose(positions[:, 1], expected, atol=0.004)


def test_pause_and_play_lose_nothing_that_was_heard(device, clock):
    player = SoundPlayer(ramp(), device, clock=clock)
    player.play()
    run(player, device, clock, 0.3)
    player.pause()
    at = player.position()
    assert at == pytest.approx(0.25, abs=1e-6)
    samples, positions = run(player, device, clock, 0.3)
    assert not samples[40:].any() and (positions[:, 1] == at).all()
    player.play()
    samples, _ = run(player, device, clock, 0.1)
    assert samples[40] == 1 + round(at * RATE) + 40 and player.position() == pytest.approx(at + 0.05)


def test_seek_works_playing_and_paused(device, clock):
    player = SoundPlayer(ramp(), device, clock=clock)
    player.seek(0.5)
    assert player.position() == 0.5
    player.play()
    samples, _ = run(player, device, clock, 0.1)
    assert samples[100] == 0.5 * RATE + 101
    player.seek(-3)
    assert player.position() == 0
    samples, _ = run(player, device, clock, 0.1)
    assert samples[100] == 101


def test_jumps_do_not_click(device, clock):
    """A tone that is paused and sought has no step larger than the tone's own."""
    tone = np.rint(9000 * np.sin(2 * np.pi * 100 * np.arange(RATE) / RATE)).astype(np.int16)[:, None]
    player = SoundPlayer(Sound(tone, RATE), device, clock=clock)
    parts = [run(player, device, clock, 0.06)[0]]
    for change in (player.play, lambda: player.seek(0.5025), player.pause, player.play, player.pause):
        change()
        parts.append(run(player, device, clock, 0.0625, gulp=125)[0])
    steps = np.abs(np.diff(np.concatenate(parts).astype(int)))
    assert np.abs(parts[2]).max() > 8000 and not parts[3][50:].any()
    assert steps.max() < 2.2 * 9000 * 2 * np.pi * 100 / RATE


def test_a_position_that_is_no_number_is_ignored(device, clock):
    player = SoundPlayer(ramp(), device, clock=clock)
    player.seek(0.25)
    for wild in (float("nan"), float("inf"), -float("inf")):
        player.seek(wild)
    assert player.position() == 0.25
    player.seek(1e300)
    player.play()
    samples, _ = run(player, device, clock, 0.1)
    assert not samples.any()


def test_after_its_end_a_sound_is_silent_and_time_goes_on(device, clock):
    player = SoundPlayer(ramp(0.1), device, clock=clock)
    player.play()
    samples, _ = run(player, device, clock, 0.5)
    assert samples[799] == 800 and not samples[800:].any() and player.position() == pytest.approx(0.45)


@pytest.mark.parametrize("loop", [0.07, 0.17])
def test_a_loop_repeats_the_sound_to_the_sample_and_the_position_grows_on(loop, device, clock):
    player = SoundPlayer(ramp(0.1), device, loop=loop, clock=clock)
    player.play()
    samples, positions = run(player, device, clock, 0.5)
    once = np.zeros(round(loop * RATE), int)
    once[: min(800, len(once))] = np.arange(1, min(800, len(once)) + 1)
    assert samples[400:].tolist() == np.resize(once, 4000)[400:].tolist()
    assert (np.diff(positions[:, 1]) >= 0).all() and player.position() == pytest.approx(0.45)
    assert player.heard() == pytest.approx(0.45 % loop)


def test_speed_moves_samples_and_position_alike(device, clock):
    player = SoundPlayer(ramp(), device, clock=clock)
    player.speed = 2.5
    player.play()
    samples, _ = run(player, device, clock, 0.2)
    assert samples[1000] == round(1 + 2.5 * 1000) and player.position() == pytest.approx(2.5 * 0.15)
    assert player.heard() is None
    at = player.position()
    player.speed = 1
    assert player.position() == pytest.approx(at)


def test_without_a_device_time_goes_on_in_silence(clock):
    player = SoundPlayer(ramp(), None, clock=clock)
    assert player.silent
    player.play()
    clock.now += 3.25
    assert player.position() == pytest.approx(3.25)
    player.pause()
    clock.now += 1
    assert player.position() == pytest.approx(3.25)


def test_closing_closes_the_device(device, clock):
    with SoundPlayer(ramp(), device, clock=clock) as player:
        player.play()
    assert device.closed and not player.playing
    player.close()


def test_a_missing_device_is_one_line(monkeypatch, caplog):
    def refuse(*_):
        raise NoDeviceError("no device (of this test)")

    monkeypatch.setattr(sound_module, "MiniaudioDevice", refuse)
    caplog.set_level(logging.INFO)
    with SoundPlayer.open(ramp()) as player:
        assert player.silent
    assert [r.getMessage() for r in caplog.records] == ["sound: no device (of this test); playing in silence"]


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "miniaudio", None)
    with pytest.raises(NoDeviceError, match=r"cap4d\[live\]"):
        MiniaudioDevice(48000, 2)


def test_a_machine_without_sound_hears_no_complaints():
    pytest.importorskip("miniaudio")
    program = "from cap4d.app.sound import open_device; d = open_device(48000, 2); d and d.close()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0 and "ALSA" not in done.stderr


def test_miniaudio_plays_to_nobody_in_real_time():
    pytest.importorskip("miniaudio")
    sound = Sound(np.ones((48000, 2), np.int16), 48000)
    with SoundPlayer(sound, MiniaudioDevice(48000, 2, null=True)) as player:
        player.play()
        deadline, seen = time.monotonic() + 20, [player.position()]
        while seen[-1] < 0.3 and time.monotonic() < deadline:
            time.sleep(0.01)
            seen.append(player.position())
    assert seen[-1] >= 0.3 and (np.diff(seen) >= 0).all()
    assert threading.active_count() < 50
