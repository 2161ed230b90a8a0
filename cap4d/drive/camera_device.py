"""Pictures that come by themselves: a camera, or a video that stands in for one."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from cap4d.capture.video import open_video, video_frames
from cap4d.errors import ArgumentError

WIDTH, HEIGHT, FPS = 640, 480, 30  # what a camera is asked for: MediaPipe looks at 192 px of a face
SUFFIXES = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v")


class CameraDevice(Protocol):
    """Something that takes pictures at a rate of its own. `read` and `close` are called from one thread."""

    def read(self) -> np.ndarray | None:
        """uint8[H, W, 3] RGB, the next picture, when it is there; None: the camera is gone."""

    def close(self) -> None:
        """Gives the camera back."""


class Webcam:
    """A camera of this machine, through OpenCV (V4L2, AVFoundation, Media Foundation).

    Args:
        index: 0 is the first camera.
    Raises:
        OSError: There is none, or something else has it.
    """

    def __init__(self, index: int) -> None:
        import cv2

        self._error = cv2.error
        with _quiet(cv2):
            self._capture = cv2.VideoCapture(index)
        if not self._capture.isOpened():
            raise OSError(f"no camera {index}")
        settings = {
            cv2.CAP_PROP_FRAME_WIDTH: WIDTH,
            cv2.CAP_PROP_FRAME_HEIGHT: HEIGHT,
            cv2.CAP_PROP_FPS: FPS,
            cv2.CAP_PROP_BUFFERSIZE: 1,  # a picture that waits is an old picture
        }
        for name, value in settings.items():
            self._capture.set(name, value)

    def read(self) -> np.ndarray | None:
        """See `CameraDevice`."""
        try:
            taken, picture = self._capture.read()
        except self._error:
            return None
        if not taken or picture is None or picture.ndim != 3:
            return None
        return np.ascontiguousarray(picture[..., ::-1])

    def close(self) -> None:
        """See `CameraDevice`."""
        self._capture.release()


class PlayedVideo:
    """A video file that plays at its own rate, over and over: a camera for tests and demonstrations.

    Args:
        path: The file.
        clock, wait: s, and a pause of some s.
    Raises:
        DataError: It is no video.
    """

    def __init__(
        self,
        path: Path,
        *,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._path, self._clock, self._wait = path, clock, wait
        with open_video(path) as container:
            self._period = float(1 / (container.streams.video[0].average_rate or FPS))
        self._frames: Iterator[np.ndarray] = iter(())
        self._due: float | None = None

    def read(self) -> np.ndarray | None:
        """See `CameraDevice`; None if the file does not decode any more."""
        picture = next(self._frames, None)
        if picture is None:
            self._frames = video_frames(self._path)
            picture = next(self._frames, None)
        now = self._clock()
        self._due = now if self._due is None else max(self._due + self._period, now - 1)
        if self._due > now:
            self._wait(self._due - now)
        return picture

    def close(self) -> None:
        """See `CameraDevice`."""
        self._frames = iter(())


def open_camera(device: str) -> CameraDevice:
    """`0` is the first camera; a path of a video plays it.

    Raises:
        ArgumentError: Neither a number nor a video file that is there.
        DataError: The file is no video.
        OSError: There is no such camera now.
    """
    check_device(device)
    return Webcam(int(device)) if device.isdecimal() else PlayedVideo(Path(device))


def check_device(device: str) -> None:
    """Raises ArgumentError unless `device` is a small number or a video file that is there."""
    if device.isascii() and device.isdecimal() and len(device) <= 3:
        return
    path = Path(device)
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        raise ArgumentError(
            f"webcam: expected webcam://0 or webcam:///path/to/video.mp4, got webcam://{device}"
        )


class Newest:
    """A box for one thing: what is put in replaces what nobody took.

    Attributes:
        dropped: Things that nobody took.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._thing: object | None = None
        self._changed = threading.Condition()

    def put(self, thing: object) -> None:
        """Never blocks."""
        with self._changed:
            self.dropped += self._thing is not None
            self._thing = thing
            self._changed.notify()

    def take(self, timeout: float) -> object | None:
        """The thing; None when there is none for `timeout` s."""
        with self._changed:
            self._changed.wait_for(lambda: self._thing is not None, timeout)
            thing, self._thing = self._thing, None
            return thing


@contextlib.contextmanager
def _quiet(cv2) -> Iterator[None]:
    """OpenCV reports every camera that is not there on stderr."""
    logging = cv2.utils.logging
    level = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)
