"""Sound files for tests."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np


def wav_bytes(samples: np.ndarray, rate: int) -> bytes:
    """A .wav of int16 or float32 [N, C]."""
    kind, width = (1, 2) if samples.dtype == np.int16 else (3, 4)
    channels, data = samples.shape[1], samples.tobytes()
    layout = struct.pack(
        "<HHIIHH", kind, channels, rate, rate * channels * width, channels * width, 8 * width
    )
    chunks = (
        b"WAVEfmt " + struct.pack("<I", len(layout)) + layout + b"data" + struct.pack("<I", len(data)) + data
    )
    return b"RIFF" + struct.pack("<I", len(chunks)) + chunks


def write_wav(path: Path, samples: np.ndarray, rate: int) -> Path:
    path.write_bytes(wav_bytes(samples, rate))
    return path


def click(at: float, *, seconds: float = 2.0, rate: int = 48000, channels: int = 1) -> np.ndarray:
    """int16[N, C]: silence but for 5 ms of 1 kHz from `at` s on."""
    samples = np.zeros((round(seconds * rate), channels), np.int16)
    first, count = round(at * rate), rate // 200
    samples[first : first + count] = (
        20000 * np.sin(np.arange(1, count + 1) * 2 * np.pi * 1000 / rate)[:, None]
    )
    return samples
