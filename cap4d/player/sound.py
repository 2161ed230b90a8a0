"""Recorded sound in memory: a .wav, read through PyAV. What plays it is `app/sound.py`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.errors import ArgumentError, DataError

MAX_SECONDS = 1800  # of a file; 330 MB of 48 kHz stereo
MAX_CHANNELS = 64  # of a file; more than two are mixed down
RATES = (4000, 48_000)  # Hz, of what is kept; a file outside them is resampled
FILE_RATES = (1000, 1_000_000)  # Hz


@dataclass(frozen=True, eq=False)
class Sound:
    """Samples on one clock.

    Args:
        samples: int16[N, C], C = 1 or 2.
        rate: Samples a second.
    """

    samples: np.ndarray
    rate: int

    def __post_init__(self) -> None:
        samples = self.samples
        if samples.dtype != np.int16 or samples.ndim != 2 or samples.shape[1] not in (1, 2):
            found = f"{samples.dtype}{list(samples.shape)}"
            raise ArgumentError(f"samples: expected int16[N, 1 or 2], got {found}")
        if not RATES[0] <= self.rate <= RATES[1]:
            raise ArgumentError(f"rate: expected {RATES[0]} to {RATES[1]} Hz, got {self.rate}")

    @property
    def duration(self) -> float:
        """s."""
        return len(self.samples) / self.rate

    @property
    def channels(self) -> int:
        return self.samples.shape[1]

    @classmethod
    def load(cls, path: str | Path) -> Sound:
        """Reads a .wav of any sample format, up to half an hour.

        Raises:
            ArgumentError: There is no such file.
            DataError: It is no .wav, holds no sound, or too much of it.
        """
        path = Path(path)
        if not path.is_file():
            raise ArgumentError(f"audio: expected a .wav file, got {path}")
        import av

        try:
            # The format is named: what a file says it is does not choose among FFmpeg's hundreds of parsers.
            with av.open(str(path), format="wav", metadata_errors="replace") as container:
                return _read(path, container)
        except (av.FFmpegError, OSError, ValueError) as error:
            found = getattr(error, "strerror", None) or str(error)
            raise DataError(path, "audio", expected="a .wav file", found=found[:200]) from None

    def between(self, first: int, last: int) -> np.ndarray:
        """int16[last - first, C]: samples [first, last); silence before the first and after the last."""
        out = np.zeros((max(last - first, 0), self.channels), np.int16)
        start, stop = max(first, 0), min(last, len(self.samples))
        if start < stop:
            out[start - first : stop - first] = self.samples[start:stop]
        return out


def _read(path: Path, container: Any) -> Sound:
    if not container.streams.audio:
        raise DataError(path, "audio", expected="a stream of sound", found="none")
    context = container.streams.audio[0].codec_context
    if context is None:
        raise DataError(path, "samples", expected="plain ones (PCM)", found="an unknown kind")
    channels, rate = context.channels, context.sample_rate or 0
    if not 1 <= channels <= MAX_CHANNELS:
        raise DataError(path, "channels", expected=f"1 to {MAX_CHANNELS}", found=channels)
    if not FILE_RATES[0] <= rate <= FILE_RATES[1]:
        raise DataError(path, "rate", expected=f"{FILE_RATES[0]} to {FILE_RATES[1]} Hz", found=rate)
    if not context.name.startswith("pcm_"):
        raise DataError(path, "samples", expected="plain ones (PCM)", found=context.name)
    rate = min(max(rate, RATES[0]), RATES[1])
    blocks, count = [], 0
    for block in _blocks(container, min(channels, 2), rate):
        count += len(block)
        if count > MAX_SECONDS * rate:
            raise DataError(path, "audio", expected=f"at most {MAX_SECONDS} s", found="more")
        blocks.append(block)
    if not count:
        raise DataError(path, "audio", expected="at least one sample", found="none")
    return Sound(np.concatenate(blocks), rate)


def _blocks(container: Any, channels: int, rate: int) -> Iterator[np.ndarray]:
    """int16[n, C] after one another, resampled to `rate`."""
    import av

    layout = "mono" if channels == 1 else "stereo"
    resampler = av.AudioResampler(format="s16", layout=layout, rate=rate)
    for frame in container.decode(audio=0):
        for part in resampler.resample(frame):
            yield part.to_ndarray().reshape(-1, channels)
    for part in resampler.resample(None):
        yield part.to_ndarray().reshape(-1, channels)
