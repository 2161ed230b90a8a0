"""The sound of a video: AAC beside the pictures, cut to exactly their length."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np

from cap4d.player.sound import Sound

RATE = 48_000  # Hz; AAC knows few rates, and every player knows this one
BIT_RATE = 160_000  # per second
SLACK_SECONDS = (
    0.04  # by which sound and picture may differ before the sound jumps; the eye sees from 45 ms on
)


class Soundtrack:
    """A stream of sound in a container that is being written.

    Args:
        container: PyAV's, open for writing.
        sound: What is heard.
        fps: Pictures a second.
    """

    def __init__(self, container: Any, sound: Sound, fps: Fraction) -> None:
        import av

        self.sound, self.fps = sound, fps
        layout = "mono" if sound.channels == 1 else "stereo"
        self._container = container
        self._stream = container.add_stream("aac", rate=RATE, layout=layout, options={"b": str(BIT_RATE)})
        self._resampler = av.AudioResampler(format="fltp", layout=layout, rate=RATE)
        self._written = 0  # samples, at the sound's rate
        self._next = 0  # sample of the sound that goes on where the last picture's ended

    def write(self, pictures: int, sound_at: float | None) -> None:
        """Appends the sound of picture `pictures` - 1.

        Args:
            pictures: How many there are with this one.
            sound_at: Where the sound is at this picture, s; the sound goes on without a gap while that is
                within `SLACK_SECONDS` of it. None: where the picture is in the video; NaN: silence.
        """
        count = round(pictures * self.sound.rate / self.fps) - self._written
        if sound_at is None:
            self._next = self._written
        elif math.isfinite(sound_at):
            first = round(min(max(sound_at, -1e6), 1e6) * self.sound.rate)
            if abs(first - self._next) > SLACK_SECONDS * self.sound.rate:
                self._next = first
        if sound_at is None or math.isfinite(sound_at):
            samples = self.sound.between(self._next, self._next + count)
            self._next += count
        else:
            samples = np.zeros((count, self.sound.channels), np.int16)
        self._encode(samples)

    def end(self) -> None:
        """Writes what the encoder still holds."""
        self._mux(self._resampler.resample(None))
        self._container.mux(self._stream.encode(None))

    def _encode(self, samples: np.ndarray) -> None:
        import av

        if not len(samples):  # more pictures a second than samples
            return
        frame = av.AudioFrame.from_ndarray(
            samples.reshape(1, -1), format="s16", layout=self._resampler.layout.name
        )
        frame.sample_rate, frame.time_base = self.sound.rate, Fraction(1, self.sound.rate)
        frame.pts = self._written
        self._written += len(samples)
        self._mux(self._resampler.resample(frame))

    def _mux(self, frames: list[Any]) -> None:
        for frame in frames:
            self._container.mux(self._stream.encode(frame))
