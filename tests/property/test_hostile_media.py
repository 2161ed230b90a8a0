"""Sounds and images with bytes changed at random are read, or refused by name; nothing else happens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cap4d.app.background import Picture
from wav_files import click, wav_bytes

from cap4d.errors import DataError
from cap4d.player.png import encode_png
from cap4d.player.sound import Sound

CHANGES = 300  # files of each kind


def changed(data: bytes, rng: np.random.Generator) -> bytes:
    """A few bytes replaced, most of them near the start; or an end cut off, or a piece repeated."""
    found = np.frombuffer(data, np.uint8).copy()
    for _ in range(rng.integers(1, 6)):
        reach = 64 if rng.random() < 0.7 else len(found)
        found[rng.integers(reach)] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.integers(256)])
    kind, at = rng.integers(6), rng.integers(1, len(found))
    if kind == 0:
        found = found[:at]
    elif kind == 1:
        found = np.concatenate([found[:at], found[at // 2 :]])
    return found.tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_changed_sounds(seed: int, tmp_path: Path) -> None:
    rng, path, read = np.random.default_rng(seed), tmp_path / "a.wav", 0
    kinds = click(0.01, seconds=0.05, channels=2), click(0.01, seconds=0.05).astype(np.float32) / 32768
    for k in range(CHANGES):
        path.write_bytes(changed(wav_bytes(kinds[k % 2], 48000), rng))
        try:
            sound = Sound.load(path)
        except DataError as error:
            assert str(error).startswith(f"{path}: ")
        else:
            assert len(sound.samples) <= 48000 * 60 and sound.channels in (1, 2)
            read += 1
    assert 0 < read < CHANGES


def test_changed_images(tmp_path: Path) -> None:
    rng, path, read = np.random.default_rng(0), tmp_path / "a.png", 0
    whole = encode_png(rng.integers(256, size=(24, 16, 4), dtype=np.uint8))
    for _ in range(CHANGES):
        path.write_bytes(changed(whole, rng))
        try:
            picture = Picture.load(path)
        except DataError as error:
            assert str(error).startswith(f"{path}: ")
        else:
            assert max(picture.pixels.shape[:2]) <= 4096
            read += 1
    assert 0 < read < CHANGES
