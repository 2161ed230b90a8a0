"""Sound: .wav files into memory, and beside the pictures of a video."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import av
import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import tiny_bundle
from wav_files import click, wav_bytes, write_wav

from cap4d.errors import ArgumentError, DataError
from cap4d.player import sound as sound_module
from cap4d.player.avatar import Avatar
from cap4d.player.offline import Output, render_to
from cap4d.player.sound import Sound
from cap4d.player.video import VideoWriter


def heard(path: Path) -> tuple[np.ndarray, float]:
    """float32[N] the mono sound of a video at 48 kHz, and when it starts, s."""
    resampler, parts, start = av.AudioResampler(format="flt", layout="mono", rate=48000), [], None
    with av.open(str(path)) as file:
        for frame in file.decode(audio=0):
            start = float(frame.pts * frame.time_base) if start is None else start
            parts += [part.to_ndarray().ravel() for part in resampler.resample(frame)]
    return np.concatenate(parts), start


def first_loud(path: Path) -> float:
    """s."""
    samples, start = heard(path)
    return start + int(np.argmax(np.abs(samples) > 0.1)) / 48000


def first_white(path: Path) -> float:
    """s."""
    with av.open(str(path)) as file:
        for frame in file.decode(video=0):
            if frame.to_ndarray(format="gray").mean() > 128:
                return float(frame.pts * frame.time_base)
    raise AssertionError("no white picture")


def lengths(path: Path) -> tuple[float, float]:
    """s of pictures, s of sound."""
    with av.open(str(path)) as file:
        return tuple(float(s.duration * s.time_base) for s in (file.streams.video[0], file.streams.audio[0]))


def shade(white: bool) -> np.ndarray:
    return np.full((32, 32, 3), 255 * white, np.uint8)


# Files


@pytest.mark.parametrize(("channels", "kept"), [(1, 1), (2, 2), (6, 2)])
def test_a_wav_is_read_as_it_is(channels: int, kept: int, tmp_path: Path) -> None:
    samples = np.random.default_rng(0).integers(-9000, 9000, (1000, channels)).astype(np.int16)
    found = Sound.load(write_wav(tmp_path / "a.wav", samples, 44100))
    assert (found.rate, found.channels, found.duration) == (44100, kept, 1000 / 44100)
    if channels == kept:
        assert np.array_equal(found.samples, samples)


def test_rates_out_of_range_are_resampled(tmp_path: Path) -> None:
    for rate, kept in ((1000, 4000), (96000, 48000), (192000, 48000)):
        found = Sound.load(write_wav(tmp_path / "a.wav", click(0.5, seconds=1, rate=rate), rate))
        assert found.rate == kept and found.duration == pytest.approx(1, abs=1e-3)


def test_samples_that_are_no_numbers_are_not_passed_on(tmp_path: Path) -> None:
    wild = np.float32([[np.nan], [np.inf], [-np.inf], [0.5], [2.0]])
    found = Sound.load(write_wav(tmp_path / "a.wav", wild, 48000)).samples.ravel().tolist()
    assert found[3:] == [16384, 32767] and len(found) == 5


WHOLE = wav_bytes(click(0.1, seconds=0.2), 48000)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"RIFF",
        b"no sound " * 99,
        b"\x1aE\xdf\xa3" + WHOLE,
        WHOLE[:30],
        WHOLE[:44],
        WHOLE[:20] + struct.pack("<H", 0x55) + WHOLE[22:],  # MPEG layer 3
        WHOLE[:22] + struct.pack("<H", 0) + WHOLE[24:],  # channels
        WHOLE[:22] + struct.pack("<H", 65535) + WHOLE[24:],
        WHOLE[:24] + struct.pack("<I", 0) + WHOLE[28:],  # rate
        WHOLE[:24] + struct.pack("<I", 2**32 - 1) + WHOLE[28:],
    ],
)
def test_what_is_no_wav_is_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.wav").write_bytes(data)
    with pytest.raises(DataError, match=r"a\.wav: .*expected"):
        Sound.load(tmp_path / "a.wav")


def test_a_wav_that_promises_more_than_it_has_is_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "a.wav").write_bytes(WHOLE[:40] + b"\xff" * 4 + WHOLE[44:])
    assert Sound.load(tmp_path / "a.wav").duration == pytest.approx(0.2)


def test_a_long_wav_is_refused_as_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sound_module, "MAX_SECONDS", 1)
    with pytest.raises(DataError, match="at most 1 s"):
        Sound.load(write_wav(tmp_path / "a.wav", click(0, seconds=1.5), 48000))


def test_no_file_is_an_argument_error(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"audio: expected a \.wav file"):
        Sound.load(tmp_path / "none.wav")


def test_there_is_silence_around_a_sound() -> None:
    sound = Sound(np.arange(1, 5, dtype=np.int16)[:, None], 4000)
    assert sound.between(-2, 6).ravel().tolist() == [0, 0, 1, 2, 3, 4, 0, 0]
    assert sound.between(9, 11).tolist() == [[0], [0]] and len(sound.between(3, 1)) == 0


# Videos


@pytest.mark.parametrize(
    ("rate", "channels", "fps"), [(44100, 1, 30), (48000, 2, 24), (22050, 1, 30000 / 1001), (8000, 2, 60)]
)
def test_sound_and_picture_are_in_step(rate: int, channels: int, fps: float, tmp_path: Path) -> None:
    sound = Sound(click(20 / fps, rate=rate, channels=channels), rate)
    with VideoWriter(tmp_path / "a.mp4", fps=fps, sound=sound) as video:
        for k in range(40):
            video.write(shade(k == 20))
    assert first_loud(tmp_path / "a.mp4") == pytest.approx(first_white(tmp_path / "a.mp4"), abs=1e-3)


@pytest.mark.parametrize("seconds", [0.3, 1.0, 5.0])
def test_sound_is_as_long_as_the_pictures(seconds: float, tmp_path: Path) -> None:
    sound = Sound(np.full((round(48000 * seconds), 1), 9000, np.int16), 48000)
    with VideoWriter(tmp_path / "a.mp4", fps=25, sound=sound) as video:
        for _ in range(25):
            video.write(shade(False))
    assert lengths(tmp_path / "a.mp4") == pytest.approx((1, 1), abs=1e-3)
    samples, _ = heard(tmp_path / "a.mp4")
    loud = np.flatnonzero(np.abs(samples) > 0.1)
    assert loud[-1] / 48000 == pytest.approx(min(seconds, 1), abs=0.03)


def test_sound_follows_where_it_is_said_to_be(tmp_path: Path) -> None:
    """A jump, drift that is none, and silence."""
    fps, sound = 20, Sound(click(1.5), 48000)
    drifting = 0.003 * np.sin(np.arange(60))
    with VideoWriter(tmp_path / "a.mp4", fps=fps, sound=sound) as video:
        for _ in range(20):
            video.write(shade(False), sound_at=math.nan)
        for k in range(20, 40):
            video.write(shade(k == 30), sound_at=1.0 + (k - 20) / fps + drifting[k])
    assert first_white(tmp_path / "a.mp4") == 1.5
    assert first_loud(tmp_path / "a.mp4") == pytest.approx(1.5, abs=0.005)


def test_pictures_have_no_sound(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"audio: expected \*.mp4"):
        VideoWriter(tmp_path / "a.png", fps=24, sound=Sound(click(0), 48000))


def test_a_render_takes_a_wav(tmp_path: Path) -> None:
    avatar = Avatar(tiny_bundle(8, gaussians=1, network=False))
    audio = write_wav(tmp_path / "a.wav", click(0.25, seconds=9), 48000)
    render_to(avatar, avatar.idle, "static", Output(tmp_path / "a.mp4", frames=12, audio=audio))
    assert lengths(tmp_path / "a.mp4") == pytest.approx((0.5, 0.5), abs=1e-3)
    assert first_loud(tmp_path / "a.mp4") == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize(("out", "audio"), [("a.png", "a.wav"), ("a.mp4", "none.wav"), ("a.mp4", "bad.wav")])
def test_a_render_refuses_before_it_draws(out: str, audio: str, tmp_path: Path) -> None:
    write_wav(tmp_path / "a.wav", click(0), 48000)
    (tmp_path / "bad.wav").write_bytes(b"RIFF")
    avatar = Avatar(tiny_bundle(8, gaussians=1, network=False))
    wanted = Output(tmp_path / out, frames=1, audio=tmp_path / audio)
    with pytest.raises((ArgumentError, DataError), match="audio"):
        render_to(avatar, avatar.idle, "static", wanted, draw=lambda *_: pytest.fail("drew a frame"))
    assert not (tmp_path / out).exists()
