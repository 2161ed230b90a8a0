"""What the window shows, into an mp4, in a thread that the window never waits for.

`Recorder.add` copies a picture into a bounded queue, or drops it when the encoder is behind: the video then
shows the picture before it a little longer. Its rate is constant; real times decide which is seen when.
"""

from __future__ import annotations

import atexit
import logging
import math
import os
import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cap4d.app.letterbox import letterboxed

from cap4d.errors import ArgumentError
from cap4d.player.sound import Sound
from cap4d.player.video import MAX_SIDE, VideoWriter, check_output

log = logging.getLogger(__name__)

PRESETS = "veryfast", "ultrafast"  # of x264
FAST_FROM = (
    4e7  # px a second: above it two busy cores keep up with the second only (1920 x 1080 at 30 is 6.2e7)
)
QUEUED_BYTES = 96 << 20  # of pictures that wait for the encoder
QUEUED = (2, 12)  # that may wait whatever their size, and at most
MAX_GAP = 60.0  # s without a picture that the video shows; longer ones are cut to this
HEARD_ON = 0.5  # s without a picture in which sound goes on; a window that is paused shows no new ones
NICENESS = 10  # of the encoder, where threads can be nice: the window comes first

SoundAt = Callable[[], float | None]
"""Where the sound is now, s; None where nothing is heard."""


@dataclass(frozen=True, eq=False)
class _Shot:
    """A picture, the number of the video's frame that it is, and where the sound was (NaN: silent)."""

    image: np.ndarray
    slot: int
    sound_at: float | None


class Recorder:
    """Records an mp4. Close it: until then there is no file, and there is none after an error.

    Args:
        path: `*.mp4`; replaced when it exists.
        size: (width, height) px of the video. Pictures of another size are fitted in, on black.
        fps: Of the video.
        sound: Its sound, or None.
        sound_at: Where the sound is as a picture is added, for sound that is paused, sought or repeated.
            None: it starts with the first picture and goes on.
        start: Whether to start the thread (tests do not).
    Raises:
        ArgumentError: No such file can be written, or the size or rate is out of range.
    """

    def __init__(
        self,
        path: str | Path,
        size: tuple[int, int],
        fps: float,
        sound: Sound | None = None,
        *,
        sound_at: SoundAt | None = None,
        start: bool = True,
    ) -> None:
        self.path, self.size, self.fps = Path(path), size, fps
        if self.path.suffix != ".mp4":
            raise ArgumentError(f"recording: expected *.mp4, got {path}")
        if not all(1 <= side <= MAX_SIDE for side in size):
            raise ArgumentError(f"recording: expected 1 to {MAX_SIDE} px a side, got {size[0]}x{size[1]}")
        if not 1 <= fps <= 1000:
            raise ArgumentError(f"recording: expected 1 to 1000 frames per second, got {fps:g}")
        check_output(self.path, fps=fps, size=size)
        self.sound = sound
        self.frames = 0  # of the video so far
        self.repeated = 0  # pictures that came in time, but the encoder was behind
        self._sound_at = sound_at
        self._spare: list[np.ndarray] = []  # pictures that were encoded: memory whose pages are there already
        self._shots: queue.SimpleQueue[_Shot | None] = queue.SimpleQueue()
        self._waiting = self._bytes = 0
        self._lock = threading.Lock()
        self._first: float | None = None  # when the first picture was shown, less what gaps were cut
        self._slot = -1  # of the last picture taken
        self._last = -1  # of the last picture, taken or not: how far the video goes
        self._error: Exception | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        atexit.register(self._finish)  # an exit without `close` still leaves a whole file
        if start:
            self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def error(self) -> Exception | None:
        """What ended the recording, or None. Pictures added after it are dropped, and there is no file."""
        return self._error

    @property
    def seconds(self) -> float:
        """Length of the video so far, with what waits for the encoder."""
        return (self._last + 1) / self.fps

    def add(self, image: np.ndarray, t: float) -> bool:
        """Appends a picture; never waits and never raises for what the disk or the encoder do.

        Args:
            image: uint8[H, W, 4], row 0 on top; copied. Alpha is dropped.
            t: When it is shown, s, on any clock; one that goes back or is not finite is ignored.
        Returns:
            Whether the picture is taken: not when another has its place in the video already, the encoder is
            behind, or the recording has ended.
        """
        if self._closed or self._error is not None or not math.isfinite(t):
            return False
        slot = self._slot_at(t)
        if slot <= self._slot:
            return False
        self._last = max(self._last, slot)
        if not self._make_room(image.nbytes):
            self.repeated += 1
            return False
        self._slot = slot
        copy = self._memory(image.shape)
        np.copyto(copy, image)
        self._shots.put(_Shot(copy, slot, self._heard()))
        return True

    def close(self) -> None:
        """Waits for the encoder and finishes the file; without a picture there is none.

        Raises:
            ArgumentError: The recording failed; told once.
        """
        if self._closed:
            return
        self._finish()
        if self._error is not None:
            reason = getattr(self._error, "strerror", None) or str(self._error)
            raise ArgumentError(f"recording: {self.path} cannot be written: {reason}") from self._error

    def _finish(self) -> None:
        if not self._closed:
            self._closed = True
            self._shots.put(None)
        if self._thread.is_alive():
            self._thread.join()  # Ctrl-C here: the exit waits for the file once more
        atexit.unregister(self._finish)

    def _slot_at(self, t: float) -> int:
        if self._first is None:
            self._first = t
        gap = t - (self._first + self._slot / self.fps)
        if gap > MAX_GAP:
            self._first += gap - MAX_GAP
        return math.floor((t - self._first) * self.fps + 0.5)

    def _make_room(self, size: int) -> bool:
        """Whether a picture of `size` bytes may wait with the others."""
        with self._lock:
            fits = self._waiting < QUEUED[1] and self._bytes + size <= QUEUED_BYTES
            if fits or self._waiting < QUEUED[0]:
                self._waiting, self._bytes = self._waiting + 1, self._bytes + size
                return True
        return False

    def _make_free(self, size: int, unused: np.ndarray | None) -> None:
        """A picture of `size` bytes waits no longer; the memory of the one before it is `unused` now."""
        with self._lock:
            self._waiting, self._bytes = self._waiting - 1, self._bytes - size
            if unused is not None:
                self._spare.append(unused)

    def _memory(self, shape: tuple[int, ...]) -> np.ndarray:
        with self._lock:
            self._spare = [image for image in self._spare if image.shape == shape][: QUEUED[1]]
            if self._spare:
                return self._spare.pop()
        return np.empty(shape, np.uint8)

    def _heard(self) -> float | None:
        if self.sound is None or self._sound_at is None:
            return None
        at = self._sound_at()
        return math.nan if at is None else at

    def _run(self) -> None:
        _be_nice()
        try:
            self._write()
        except Exception as error:  # the thread's last word: the disk is full, the encoder refuses
            self._error = error
            log.error("recording: %s: %s", self.path, getattr(error, "strerror", None) or error)

    def _write(self) -> None:
        last, shown = None, None  # the picture as the video has it, and as it came
        rate = self.size[0] * self.size[1] * self.fps
        preset = PRESETS[rate > FAST_FROM]
        with VideoWriter(self.path, fps=self.fps, sound=self.sound, preset=preset) as video:
            while (shot := self._shots.get()) is not None:
                if last is not None:
                    self._repeat(video, last, shot.slot)
                last = _Shot(letterboxed(shot.image, self.size), shot.slot, shot.sound_at)
                self._write_one(video, last, 0.0)
                self._make_free(shot.image.nbytes, shown)
                shown = shot.image
            if last is not None:
                self._repeat(video, last, self._last + 1)

    def _repeat(self, video: VideoWriter, last: _Shot, until: int) -> None:
        """Shows `last` up to frame `until`."""
        for slot in range(last.slot + 1, until):
            self._write_one(video, last, (slot - last.slot) / self.fps)

    def _write_one(self, video: VideoWriter, shot: _Shot, later: float) -> None:
        at = shot.sound_at
        if at is not None:
            at = at + later if later <= HEARD_ON else math.nan
        video.write(shot.image, sound_at=at)
        self.frames += 1


def _be_nice() -> None:
    """Linux has niceness per thread, and threads made by this one (the encoder's) inherit it."""
    if sys.platform == "linux":
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        except OSError:
            log.debug("recorder: no niceness here")
