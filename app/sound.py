"""A sound that plays beside the pictures, and whose clock rules them.

`SoundPlayer.position` is where the sound is heard now. A device plays it (through miniaudio, which brings
all it needs along: `pip install "cap4d[live]"`); without the package or a device time goes on in silence.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any, Protocol

import numpy as np
from cap4d.app.sound_clock import SoundClock

from cap4d.player.sound import Sound

log = logging.getLogger(__name__)

PERIOD_MS = 20  # that the device asks for at once
PERIODS = 4  # that it keeps: what Python's other threads may take before the sound breaks off
SPEEDS = 0.1, 8.0
RAMP_SECONDS = 0.005  # in which a sound swells and fades where it starts, stops or jumps: else it clicks
MAX_POSITION = 1e6  # s

Fill = Callable[[int], np.ndarray]
"""(frames) -> int16[frames, C]: called by the device's own thread."""


class NoDeviceError(Exception):
    """There is nothing to play on; the text says why."""


class SoundDevice(Protocol):
    """Plays what it asks for."""

    latency: float
    """s from `fill` to the ear."""

    def start(self, fill: Fill) -> None:
        """Asks `fill` for samples, in a thread of its own, until `close`."""
        ...

    def close(self) -> None: ...


class MiniaudioDevice:
    """The system's default output.

    Args:
        rate, channels: Of what `fill` gives.
        null: A device that plays to nobody, at the right speed: for tests.
    Raises:
        NoDeviceError: No package, no sound system, or no device.
    """

    def __init__(self, rate: int, channels: int, *, null: bool = False) -> None:
        try:
            import miniaudio
        except ImportError:
            raise NoDeviceError('the package miniaudio is missing (pip install "cap4d[live]")') from None
        backends = (
            [miniaudio.Backend.NULL] if null else [b for b in _backends() if b != miniaudio.Backend.NULL]
        )
        settings = {"nchannels": channels, "sample_rate": rate, "buffersize_msec": PERIOD_MS}
        try:
            with _muted_stderr():  # ALSA complains there, in twenty lines
                self._device = miniaudio.PlaybackDevice(
                    **settings, callback_periods=PERIODS, backends=backends, app_name="cap4d"
                )
        except (miniaudio.MiniaudioError, OSError) as error:
            raise NoDeviceError(f"no device ({error.args[0] if error.args else error})") from None
        self.latency = (PERIODS - 1) * PERIOD_MS / 1000  # what it asks for follows the periods that it holds

    def start(self, fill: Fill) -> None:
        """See `SoundDevice`."""
        asked = _asked(fill)
        next(asked)
        self._device.start(asked)

    def close(self) -> None:
        """Returns when `fill` is no longer called."""
        self._device.close()


def open_device(rate: int, channels: int) -> SoundDevice | None:
    """The system's output, or None and one line that says why there is none."""
    try:
        return MiniaudioDevice(rate, channels)
    except NoDeviceError as error:
        log.info("sound: %s; playing in silence", error)
        return None


class SoundPlayer:
    """Plays, pauses and seeks one sound. Paused at 0 at first; not for calls from two threads at once.

    After its end, or before its start, a sound is silent and time goes on.

    Args:
        sound: What to play.
        device: What on; None is silence. It is closed with the player.
        loop: s after which it starts again (the clip's length), or None. The position does not: it grows on.
        clock: s, only forward.
    """

    def __init__(
        self,
        sound: Sound,
        device: SoundDevice | None,
        *,
        loop: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.sound, self._device, self._clock = sound, device, clock
        self.loop = loop if loop and loop > 0 else None
        self._lock = threading.Lock()  # between the device's thread and the caller's
        self._playing, self._speed = False, 1.0
        self._start = 0.0  # position at which playing was started, s
        self._handed = 0  # samples given to the device since
        self._gain = 0.0  # of the last sample given
        self._next = self._tail = np.zeros(0)  # sample numbers that would follow it; those that fade out now
        self._heard = SoundClock(device.latency if device is not None else 0.0)
        if device is not None:
            device.start(self._fill)

    @classmethod
    def open(cls, sound: Sound) -> SoundPlayer:
        """On the system's output, or in silence."""
        return cls(sound, open_device(sound.rate, sound.channels))

    @property
    def playing(self) -> bool:
        return self._playing

    @property
    def silent(self) -> bool:
        """Whether there is no device."""
        return self._device is None

    @property
    def speed(self) -> float:
        """Seconds of sound a second; other than 1, pitch follows."""
        return self._speed

    @speed.setter
    def speed(self, value: float) -> None:
        at = self.position()
        with self._lock:
            self._speed = min(max(float(value), SPEEDS[0]), SPEEDS[1])
            self._restart(at)

    def play(self) -> None:
        """Goes on from where it is."""
        if not self._playing:
            with self._lock:
                self._playing = True
                self._restart(self._start)

    def pause(self) -> None:
        """Stands still where it is."""
        if self._playing:
            at = self.position()
            with self._lock:
                self._playing = False
                self._restart(at)

    def seek(self, position: float) -> None:
        """Goes on, or stands, at `position` s; not before 0. What is no number is ignored."""
        with self._lock:
            if math.isfinite(position):
                self._restart(min(max(float(position), 0.0), MAX_POSITION))

    def position(self) -> float:
        """What is heard now, s; while playing it never goes back."""
        with self._lock:
            if not self._playing:
                return self._start
            return self._start + self._speed * self._heard.heard(self._clock())

    def heard(self) -> float | None:
        """Where the sound itself is, for `Recorder`'s `sound_at`; None: paused, or not at its own speed."""
        if not self._playing or self._speed != 1:
            return None
        at = self.position()
        return at if self.loop is None else at % self.loop

    def close(self) -> None:
        """Ends playing and closes the device."""
        self.pause()
        if self._device is not None:
            self._device.close()
            self._device = None

    def __enter__(self) -> SoundPlayer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _restart(self, at: float) -> None:
        self._start, self._handed, self._gain = at, 0, 0.0
        self._tail, self._next = self._next, np.zeros(0)
        self._heard.restart()
        if self._device is None:  # what is asked for at once is heard at once
            self._heard.gulp(0.0, self._clock())

    def _fill(self, count: int) -> np.ndarray:
        """int16[count, C]: what follows what was given."""
        with self._lock:
            out = (
                self._playing_on(count) if self._playing else np.zeros((count, self.sound.channels), np.int16)
            )
            tail, self._tail = self._tail[:count], np.zeros(0)
        if len(tail):
            gains = np.linspace(1, 0, len(tail), endpoint=False)[:, None]
            faded = out[: len(tail)] + self._samples(tail) * gains
            out[: len(tail)] = np.clip(np.rint(faded), -32768, 32767)
        return out

    def _playing_on(self, count: int) -> np.ndarray:
        rate, step = self.sound.rate, self._speed
        self._heard.gulp(self._handed / rate, self._clock())
        at = self._start * rate + (self._handed + np.arange(count)) * step
        self._handed += count
        out = self._swelling(self._samples(at))
        if self._gain == 1:
            self._next = at[-1] + step * np.arange(1, round(RAMP_SECONDS * rate) + 1)
        return out

    def _samples(self, at: np.ndarray) -> np.ndarray:
        """int16[n, C] at sample numbers float64[n], those between samples interpolated."""
        if self.loop is not None:
            at = at % (self.loop * self.sound.rate)
        whole = np.floor(at)
        share, index = (at - whole)[:, None], whole.astype(np.int64)
        mixed = self._at(index) * (1 - share) + self._at(index + 1) * share
        return np.rint(mixed).astype(np.int16)

    def _at(self, index: np.ndarray) -> np.ndarray:
        """int16[n, C]: those samples, or silence where there are none."""
        samples = self.sound.samples
        there = (index >= 0) & (index < len(samples))
        return samples[np.clip(index, 0, len(samples) - 1)] * there[:, None]

    def _swelling(self, samples: np.ndarray) -> np.ndarray:
        """From silence to full loudness within `RAMP_SECONDS` of a start."""
        if self._gain < 1:
            gains = self._gain + np.arange(1, len(samples) + 1) / (RAMP_SECONDS * self.sound.rate)
            samples = (samples * np.minimum(gains, 1)[:, None]).astype(np.int16)
            self._gain = min(float(gains[-1]), 1.0) if len(gains) else self._gain
        return samples


def _asked(fill: Fill) -> Generator[np.ndarray, int, None]:
    """`fill` as miniaudio calls it."""
    count = yield np.zeros((0, 1), np.int16)
    while True:
        count = yield fill(count)


def _backends() -> list[Any]:
    import miniaudio

    return list(miniaudio.get_enabled_backends())


@contextlib.contextmanager
def _muted_stderr() -> Iterator[None]:
    """Sends what C libraries write to stderr nowhere."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
