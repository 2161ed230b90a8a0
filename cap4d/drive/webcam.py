"""A face before a camera drives an avatar: MediaPipe finds it, the avatar's own rig explains it.

Pictures never leave the process, and none is kept.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.camera_device import CameraDevice, Newest, check_device, open_camera
from cap4d.drive.face_driver import FaceDriver
from cap4d.drive.landmark_head import LandmarkHead, find_landmark_head
from cap4d.drive.packet import Packet, Sink
from cap4d.errors import ArgumentError, Cap4dError

log = logging.getLogger(__name__)

RETRY = 1.0  # s until a camera that is gone is asked for again
PATIENCE = 0.1  # s at a time of waiting for a picture
RECENT = 300  # pictures whose times are kept
INSTALL = "pip install 'cap4d[live]' and pip install --no-deps mediapipe==0.10.21 (Python 3.9 to 3.12)"


class LandmarkDetector(Protocol):
    """What finds faces: `cap4d.track.landmarks.Detector`."""

    def landmarks(self, image: np.ndarray) -> np.ndarray | None:
        """uint8[H, W, 3] -> float[478, 2] px, or None where there is no face."""


class WebcamReceiver:
    """Drives by a camera; the newest picture wins. A `Receiver`.

    Args:
        device: `0` for the first camera, or a video file that stands in for one; as in `webcam://DEVICE`.
        bundle: The avatar, whose expressions are sent.
        camera, detector, head: For tests: what opens the camera, finds landmarks, and where the avatar has
            its own.
        clock: s.
    Raises:
        ArgumentError: `device` is neither a number nor a video file.
    """

    def __init__(
        self,
        device: str,
        bundle: Bundle | None,
        *,
        camera: Callable[[str], CameraDevice] = open_camera,
        detector: Callable[[], AbstractContextManager[LandmarkDetector]] | None = None,
        head: LandmarkHead | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        device = device.removeprefix("webcam://")
        if camera is open_camera:
            check_device(device)
        self.address = f"webcam://{device}"
        self._device, self._bundle, self._open = device, bundle, camera
        self._detector, self._head, self._clock = detector or _detector, head, clock
        self._pictures = Newest()
        self._counts = dict.fromkeys(("pictures", "no_face", "reconnects"), 0)
        self._seconds = {name: deque(maxlen=RECENT) for name in ("landmarks", "solve", "arrival")}
        self.connected = False

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `Receiver`.

        Raises:
            ArgumentError: MediaPipe is not installed, or the avatar has no face that it sees.
        """
        with self._detector() as detector:
            driver = FaceDriver(self._head if self._head is not None else _look_at(self._bundle))
            over = threading.Event()  # of this run: one that fails leaves no thread with the camera
            filming = threading.Thread(target=self._film, args=(over,), name="webcam", daemon=True)
            filming.start()
            try:
                while not stop.is_set():
                    taken = self._pictures.take(PATIENCE)
                    if taken is not None:
                        self._drive(driver, detector, *taken, sink)
            finally:
                over.set()
                filming.join(PATIENCE)

    def statistics(self) -> dict[str, Any]:
        """Pictures taken, dropped, and without a face; reconnects; packets per second and median ms."""
        arrival = np.array(self._seconds["arrival"])
        rate = (len(arrival) - 1) / np.ptp(arrival) if len(arrival) > 1 and np.ptp(arrival) > 0 else 0.0
        return {
            **self._counts,
            "dropped": self._pictures.dropped,
            "connected": self.connected,
            "rate": float(rate),
            "landmarks_ms": _median_ms(self._seconds["landmarks"]),
            "solve_ms": _median_ms(self._seconds["solve"]),
        }

    def _drive(
        self, driver: FaceDriver, detector: LandmarkDetector, picture: np.ndarray, t: float, sink: Sink
    ) -> None:
        start = time.perf_counter()
        points = detector.landmarks(picture)
        found = time.perf_counter()
        packet: Packet | None = None
        if points is not None:
            packet = driver(points, picture.shape[1], picture.shape[0], t)
        self._seconds["landmarks"].append(found - start)
        if packet is None:
            self._counts["no_face"] += 1
            return
        self._seconds["solve"].append(time.perf_counter() - found)
        self._seconds["arrival"].append(self._clock())
        sink.packet(packet, self._clock())

    def _film(self, stop: threading.Event) -> None:
        """Puts pictures into the box; a camera that goes is opened again when it comes back."""
        told = False
        while not stop.is_set():
            try:
                camera = self._open(self._device)
            except (OSError, Cap4dError) as error:
                if not told:
                    log.warning("%s: %s; trying again every second", self.address, error)
                told = True
            else:
                told = not self._take_pictures(camera, stop) and told
            if not stop.wait(RETRY):
                self._counts["reconnects"] += 1

    def _take_pictures(self, camera: CameraDevice, stop: threading.Event) -> bool:
        """Until the camera is gone; whether there were any."""
        taken = 0
        try:
            while not stop.is_set() and (picture := camera.read()) is not None:
                self.connected = True
                taken += 1
                self._counts["pictures"] += 1
                self._pictures.put((picture, self._clock()))
        except (OSError, Cap4dError) as error:
            log.debug("%s: %s", self.address, error)
        finally:
            self.connected = False
            camera.close()
        if not stop.is_set():
            log.warning("%s: no pictures any more; trying again every second", self.address)
        return taken > 0


def _detector() -> AbstractContextManager[LandmarkDetector]:
    """MediaPipe's, on pictures that follow each other, silently."""
    try:
        from cap4d.track.landmarks import Detector, without_native_chatter

        with without_native_chatter():
            detector = Detector(video=True, copies=1)
            detector.landmarks(np.zeros((64, 64, 3), np.uint8))  # what it says, it says now
    except (ArgumentError, ModuleNotFoundError) as error:
        raise ArgumentError(f"webcam: expected MediaPipe and OpenCV: {INSTALL}; {error}") from error
    return detector


def _look_at(bundle: Bundle) -> LandmarkHead:
    from cap4d.track.landmarks import without_native_chatter

    with without_native_chatter():
        return find_landmark_head(bundle)


def _median_ms(seconds: deque[float]) -> float:
    return float(np.median(list(seconds)) * 1e3) if seconds else 0.0
