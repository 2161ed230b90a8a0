"""Recording: pictures at any time and of any size become a video of constant rate, or an error."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from cap4d.app import recorder as recorder_module
from cap4d.app.letterbox import letterboxed
from cap4d.app.recorder import QUEUED, Recorder
from cap4d.app.sound import SoundPlayer
from wav_files import click

from cap4d.errors import ArgumentError
from cap4d.player.sound import Sound


def grey(level: int, width: int = 32, height: int = 32) -> np.ndarray:
    return np.full((height, width, 4), level, np.uint8)


def levels(path: Path) -> list[int]:
    """The mean grey of every frame, to the nearest ten."""
    with av.open(str(path)) as file:
        return [round(f.to_ndarray(format="gray").mean() / 10) * 10 for f in file.decode(video=0)]


def record(path: Path, shots: list[tuple[int, float]], fps: float = 10) -> Recorder:
    """Adds (grey, time) before the encoder starts, so that nothing depends on its speed."""
    recorder = Recorder(path, (32, 32), fps, start=False)
    for level, t in shots:
        recorder.add(grey(level), t)
    recorder._thread.start()
    recorder.close()
    return recorder


def test_real_times_become_a_constant_rate(tmp_path: Path) -> None:
    """Jitter of less than half a frame is none; what comes too fast is left out; a gap is filled."""
    shots = [(40, 7.0), (60, 7.11), (80, 7.19), (100, 7.22), (120, 7.5), (140, 7.58)]
    recorder = record(tmp_path / "a.mp4", shots)
    assert levels(tmp_path / "a.mp4") == [40, 60, 80, 80, 80, 120, 140]
    assert (recorder.frames, recorder.repeated, recorder.seconds) == (7, 0, 0.7)


def test_a_clock_that_jumps_or_is_no_number_is_no_trouble(tmp_path: Path) -> None:
    shots = [(40, 5.0), (60, 4.0), (80, float("nan")), (100, float("inf")), (120, 5.1), (140, 1e9)]
    recorder = record(tmp_path / "a.mp4", shots, fps=2)
    found = levels(tmp_path / "a.mp4")
    assert found[0] == 40 and found[-1] == 140 and len(found) == recorder.frames
    assert recorder.seconds == pytest.approx(60.5, abs=0.5)  # the longest gap


def test_what_the_encoder_has_no_time_for_is_repeated(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mp4", (32, 32), 10, start=False)
    taken = [recorder.add(grey(5 * k), k / 10) for k in range(QUEUED[1] + 5)]
    assert taken == [True] * QUEUED[1] + [False] * 5 and recorder.repeated == 5
    recorder._thread.start()
    recorder.close()
    assert recorder.frames == QUEUED[1] + 5
    found = levels(tmp_path / "a.mp4")
    assert len(found) == QUEUED[1] + 5 and len(set(found[-6:])) == 1


def test_large_pictures_wait_in_smaller_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "QUEUED_BYTES", 3 * grey(0).nbytes)
    recorder = Recorder(tmp_path / "a.mp4", (32, 32), 10, start=False)
    assert [recorder.add(grey(0), k / 10) for k in range(4)] == [True] * 3 + [False]
    monkeypatch.setattr(recorder_module, "QUEUED_BYTES", 1)
    recorder = Recorder(tmp_path / "b.mp4", (32, 32), 10, start=False)
    assert [recorder.add(grey(0), k / 10) for k in range(3)] == [True] * QUEUED[0] + [False]


@pytest.mark.parametrize("size", [(32, 32), (31, 17), (1, 1), (2, 300)])
def test_pictures_of_any_size_fit_into_the_video(size: tuple[int, int], tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mp4", size, 10, start=False)
    for k, (width, height) in enumerate([(32, 32), (1, 1), (3, 900), (3840, 2160), (513, 17), (8200, 2)]):
        assert recorder.add(grey(200, width, height), k / 10)
    recorder._thread.start()
    recorder.close()
    with av.open(str(tmp_path / "a.mp4")) as file:
        shapes = {(f.width, f.height) for f in file.decode(video=0)}
    assert shapes == {(size[0] + size[0] % 2, size[1] + size[1] % 2)} and recorder.frames == 6


def test_the_picture_is_copied(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mp4", (32, 32), 10, start=False)
    image = grey(200)
    recorder.add(image, 0)
    image[:] = 0
    recorder._thread.start()
    recorder.close()
    assert levels(tmp_path / "a.mp4") == [200]


def test_a_letterbox_keeps_the_shape_and_the_middle() -> None:
    image = np.zeros((40, 80, 3), np.uint8)
    image[:, :40] = 200
    found = letterboxed(image, (40, 40))
    assert found.shape == (40, 40, 3) and not found[:10].any() and not found[30:].any()
    assert (found[10:30, :20] == 200).all() and not found[10:30, 20:].any()
    assert letterboxed(found, (40, 40)) is found
    single = letterboxed(np.uint8([[[9, 8, 7]]]), (3, 2))
    assert single.shape == (2, 3, 3) and (single.any(-1).sum(1) == 2).all()


def test_sound_goes_with_the_pictures(tmp_path: Path) -> None:
    """Played from 1 s on, paused after half a second."""
    positions = iter([1.0 + k / 10 for k in range(5)] + [None] * 5)
    recorder = Recorder(
        tmp_path / "a.mp4",
        (32, 32),
        10,
        Sound(click(1.3), 48000),
        sound_at=lambda: next(positions),
        start=False,
    )
    for k in range(10):
        recorder.add(grey(250 if k == 3 else 0), k / 10)
    recorder._thread.start()
    recorder.close()
    assert levels(tmp_path / "a.mp4").index(250) == 3
    parts = []
    with av.open(str(tmp_path / "a.mp4")) as file:
        parts = [frame.to_ndarray()[0] for frame in file.decode(audio=0)]
    loud = np.flatnonzero(np.abs(np.concatenate(parts)) > 0.1) / 48000
    assert loud[0] == pytest.approx(0.3, abs=2e-3) and loud[-1] < 0.32


class SteadyDevice:
    """Asks for 20 ms at a time."""

    latency = 0.06

    def start(self, fill):
        self.fill = fill

    def close(self):
        pass


def test_what_is_played_paused_and_repeated_is_recorded_in_step(tmp_path: Path) -> None:
    """The picture is white while the player says that the click is heard; so it is in the file."""
    rate, fps, now = 48000, 50, [0.0]
    device, sound = SteadyDevice(), Sound(click(0.62, seconds=0.8, rate=rate), rate)
    player = SoundPlayer(sound, device, loop=0.8, clock=lambda: now[0])
    recorder = Recorder(tmp_path / "a.mp4", (32, 32), fps, sound, sound_at=player.heard, start=False)
    keys = {20: player.play, 40: player.pause, 60: player.play}
    recorder._thread.start()
    for k in range(200):
        now[0] = k / fps
        keys.get(k, lambda: None)()
        device.fill(rate // fps)
        white = player.playing and abs(player.position() % 0.8 - 0.62) < 0.5 / fps
        while not recorder.add(grey(250 * white), now[0]):
            recorder.repeated -= 1  # this test waits for the encoder
    recorder.close()
    flashes = np.flatnonzero(np.array(levels(tmp_path / "a.mp4")) > 200) / fps
    with av.open(str(tmp_path / "a.mp4")) as file:
        samples = np.concatenate([frame.to_ndarray()[0] for frame in file.decode(audio=0)])
    loud = np.flatnonzero(np.abs(samples) > 0.1) / rate
    clicks = loud[np.diff(loud, prepend=-1) > 0.1]
    assert len(flashes) == len(clicks) == 4
    assert np.abs(flashes - clicks).max() <= 1 / fps


def test_a_gap_in_the_pictures_is_a_pause_of_the_sound(tmp_path: Path) -> None:
    loud = Sound(np.full((96000, 1), 9000, np.int16), 48000)
    recorder = Recorder(tmp_path / "a.mp4", (32, 32), 10, loud, sound_at=lambda: 0.0, start=False)
    recorder.add(grey(0), 0.0)
    recorder.add(grey(0), 1.9)
    recorder._thread.start()
    recorder.close()
    with av.open(str(tmp_path / "a.mp4")) as file:
        samples = np.concatenate([frame.to_ndarray()[0] for frame in file.decode(audio=0)])
    tenths = np.abs(samples[: 48000 * 2].reshape(20, -1)).mean(1) > 0.1
    assert tenths.tolist() == [True] * 6 + [False] * 13 + [True]


def test_there_is_no_file_before_the_end_and_none_without_pictures(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mp4", (32, 32), 10)
    assert not (tmp_path / "a.mp4").exists()
    recorder.close()
    recorder.close()
    assert not list(tmp_path.iterdir())
    assert not recorder.add(grey(0), 0)


@pytest.mark.parametrize(
    ("name", "size", "fps", "words"),
    [
        ("a.png", (9, 9), 10, r"expected \*.mp4"),
        ("none/a.mp4", (9, 9), 10, "does not exist"),
        ("a.mp4", (0, 9), 10, "px a side"),
        ("a.mp4", (9, 9000), 10, "px a side"),
        ("a.mp4", (9, 9), 0, "frames per second"),
        ("a.mp4", (9, 9), float("nan"), "frames per second"),
    ],
)
def test_what_cannot_be_recorded_is_refused(name, size, fps, words, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=words):
        Recorder(tmp_path / name, size, fps)


NOISE = "np.random.default_rng({seed}).integers(256, size=(256, 256, 4), dtype=np.uint8)"


@pytest.mark.skipif(sys.platform == "win32", reason="no limits on files there")
def test_a_full_disk_is_one_error_and_the_window_goes_on(tmp_path: Path) -> None:
    program = f"""
import resource, numpy as np
from cap4d.app.recorder import Recorder
from cap4d.errors import ArgumentError
recorder = Recorder("a.mp4", (256, 256), 30, start=False)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
for k in range(12):
    recorder.add({NOISE.format(seed="k")}, 5 * k / 30)
recorder._thread.start()
try:
    recorder.close()
except ArgumentError as error:
    print(error)
recorder.close()
print(recorder.add({NOISE.format(seed=0)}, 9.0), recorder.error is not None)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    first, second = done.stdout.splitlines()
    assert first.startswith("recording: a.mp4 cannot be written: ") and second == "False True"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ["", "raise KeyboardInterrupt"])
def test_an_exit_without_close_leaves_a_whole_file(ending: str, tmp_path: Path) -> None:
    program = f"""
import numpy as np
from cap4d.app.recorder import Recorder
recorder = Recorder("a.mp4", (64, 64), 30)
for k in range(5):
    recorder.add(np.full((64, 64, 4), 40 * k, np.uint8), k / 30)
{ending}
"""
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    assert levels(tmp_path / "a.mp4") == [0, 40, 80, 120, 160]
