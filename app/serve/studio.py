"""Where the pictures are made: one thread owns the avatar and draws for everybody who watches."""

from __future__ import annotations

import json
import logging
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from cap4d.app.orbit import Orbit
from cap4d.app.serve.jpeg import JpegEncoder
from cap4d.app.serve.message import Message
from cap4d.app.serve.painter import Painter, choose_painter
from cap4d.app.serve.performance import Performance
from cap4d.app.serve.watcher import Shot, Watcher

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import CameraPath, fitted, with_live_head
from cap4d.player.offline import head_centre

log = logging.getLogger(__name__)

LONGEST_NAP = 0.5  # s
STOP_SECONDS = 10.0  # that a picture may take to be finished
LATENCIES = 100_000  # kept for the statistics

Moment = tuple[int, int]


class Studio:
    """Draws what watchers want, the latest moment for whoever is ready. Every method is for any thread.

    Args:
        avatar: Drawn by the studio's own thread alone, from `start` on.
        performance: What it does.
        cameras: Where it is seen from until somebody takes the camera.
        turns_head: A live source turns the head; the cameras know nothing of it.
        backend: `auto`, `gl` or `cpu`.
        area: px that a picture may have.
        limit: Watchers at once.
        clock: s, only goes forward.
    """

    def __init__(
        self,
        avatar: Avatar,
        performance: Performance,
        cameras: CameraPath,
        *,
        turns_head: bool = False,
        backend: str = "auto",
        area: int = 512 * 512,
        limit: int = 4,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.avatar, self.performance, self.cameras = avatar, performance, cameras
        self.turns_head = turns_head
        self.backend, self.area, self.limit, self.clock = backend, area, limit, clock
        self.centre = head_centre(avatar)
        self.moments = 0  # drawn
        self.latencies: deque[float] = deque(maxlen=LATENCIES)
        self.error: BaseException | None = None
        self._watchers: list[Watcher] = []
        self._changed = threading.Condition()
        self._stopping = False
        self._seen: Frame | None = None  # the latest frame, for taking over the camera
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)
        self._painted = threading.Event()  # the painter is there, or failed to be

    # for the server -------------------------------------------------------------------------------

    def start(self) -> None:
        """Begins to draw.

        Raises:
            GlUnavailableError: The backend is not there.
        """
        self._thread.start()
        self._painted.wait()
        if self.error is not None:
            raise self.error

    def stop(self) -> None:
        """Ends the thread."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(STOP_SECONDS)

    @property
    def failure(self) -> BaseException | None:
        """Why nothing new is drawn any more, if so."""
        return self.error or self.performance.error

    @property
    def is_full(self) -> bool:
        with self._changed:
            return len(self._watchers) >= self.limit

    def admit(self, deliver: Callable[[bytes], None]) -> Watcher | None:
        """Somebody comes to watch; None: the house is full."""
        with self._changed:
            if len(self._watchers) >= self.limit:
                return None
            watcher = Watcher(deliver, area=self.area)
            self._watchers.append(watcher)
            self._changed.notify()
            return watcher

    def dismiss(self, watcher: Watcher) -> None:
        """Somebody has gone."""
        with self._changed:
            self._watchers.remove(watcher)

    def hear(self, watcher: Watcher, message: Message) -> bool:
        """Somebody said something; whether it changed what all of them see."""
        performance, now = self.performance, self.clock()
        with self._changed:
            if message.ack is not None:
                self._acknowledge(watcher, message.ack, now)
            watcher.look(message, self._view)
            before = performance.paused, performance.overrides.version
            if message.play is not None:
                performance.pause(not message.play, now)
            if message.seek is not None:
                performance.seek(message.seek, now)
            if message.reset:
                performance.overrides.reset()
            for name, value in message.expr.items():
                performance.hold(name, value)
            self._changed.notify()
            return before != (performance.paused, performance.overrides.version)

    def stalled(self) -> list[Watcher]:
        """Those who have not shown what they were sent for too long."""
        now = self.clock()
        with self._changed:
            return [watcher for watcher in self._watchers if watcher.flow.stalled(now)]

    def introduction(self) -> dict[str, Any]:
        """What a page is told first."""
        performance, bundle = self.performance, self.avatar.bundle
        ranges = np.round(performance.ranges.astype(np.float64), 4).tolist()
        sliders = {
            group: [[performance.names[i], *ranges[i]] for i in members]
            for group, members in performance.groups.items()
        }
        return {
            "rig": bundle.rig_name,
            "gaussians": len(bundle),
            "deformer": self.avatar.tier,
            "backend": self.backend,
            "live": performance.is_live,
            "duration": performance.duration,
            "expressions": sliders,
        }

    def state(self) -> dict[str, Any]:
        """What everybody shares."""
        with self._changed:
            return {"paused": self.performance.paused, "held": self.performance.held}

    def statistics(self) -> dict[str, Any]:
        """Of `--stats`: latencies from the begin of drawing to the echo that it is shown."""
        with self._changed:
            latencies = np.array(self.latencies) * 1e3
        if not len(latencies):
            return {"pictures": 0}
        shares = {"median": 50, "p95": 95, "p99": 99}
        found = {name: round(float(np.percentile(latencies, share)), 2) for name, share in shares.items()}
        return {"pictures": len(latencies), "latency_ms": found}

    def _acknowledge(self, watcher: Watcher, number: int, now: float) -> None:
        latency = watcher.flow.acknowledged(number, now)
        if latency is not None:
            self.latencies.append(latency)

    def _view(self) -> Orbit:
        """The camera path's place at this moment, for somebody to take over."""
        now = self.clock()
        number, _ = self.performance.number(now)
        frame = self.performance.frame() if self._seen is None else self._seen
        return Orbit.from_camera(self.cameras(number, frame), self.centre)

    # the thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            painter, encoder = choose_painter(self.backend, self.avatar), JpegEncoder()
            self.backend = painter.name
            self._painted.set()
            while self._draw_next(painter, encoder):
                pass
        except BaseException as error:
            self.error = error
            if self._painted.is_set():
                log.exception("the studio stopped")
        finally:
            self._painted.set()

    def _draw_next(self, painter: Painter, encoder: JpegEncoder) -> bool:
        """Draws the moment for all who are ready, or waits; False: it is over."""
        with self._changed:
            if self._stopping:
                return False
            now = self.clock()
            moment = self.performance.number(now)
            wanted = {w: w.shot(moment, now) for w in self._watchers if w.wants(moment, now)}
            if not wanted:
                self._changed.wait(self._nap(now))
                return True
            frame = self._seen = self.performance.frame()
            position, stream = self.performance.position, self.performance.state
        with self.avatar.stages.time("frame"):
            pictures = self._paint(painter, encoder, frame, moment, set(wanted.values()))
        done = self.clock()
        head = {"at": round(position, 3), "stream": stream, "drawn": round((done - now) * 1e3, 2)}
        with self._changed:
            self.moments += 1
            self.performance.drawn(done)
            for watcher, shot in wanted.items():
                if watcher in self._watchers:
                    data = picture_message(head, pictures[shot], watcher, shot)
                    watcher.send(data, moment, shot, begun=now, now=done)
        return True

    def _paint(
        self, painter: Painter, encoder: JpegEncoder, frame: Frame, moment: Moment, shots: set[Shot]
    ) -> dict[Shot, bytes]:
        painter.pose(frame)
        pictures = {}
        for shot in shots:
            image = painter.paint(self._camera(shot, frame, moment), shot.background)
            with self.avatar.stages.time("jpeg"):
                pictures[shot] = encoder.encode(image, shot.quantiser)
        return pictures

    def _camera(self, shot: Shot, frame: Frame, moment: Moment) -> Camera:
        if shot.orbit is not None:
            camera = shot.orbit.camera(*shot.size)
        else:
            camera = fitted(self.cameras(moment[0], frame), shot.size)
        return with_live_head(camera, frame) if self.turns_head else camera

    def _nap(self, now: float) -> float:
        """s until something may be due by itself; whoever comes or says something ends it."""
        if not self._watchers:
            return LONGEST_NAP
        sharpen = min((t for w in self._watchers if (t := w.sharpens_at()) > now), default=now + LONGEST_NAP)
        due = min(self.performance.due(), sharpen)
        return min(max(due - now, 1e-3), LONGEST_NAP)


def picture_message(head: dict[str, Any], jpeg: bytes, watcher: Watcher, shot: Shot) -> bytes:
    """u32 length of the head (little-endian), the head as JSON, the JPEG.

    The head: `n` the picture's number, to be echoed when it is shown; `at` s in the clip; `stream` a live
    stream's state; `drawn` ms; `latency` ms, median of late; `size`; `quantiser`.
    """
    latency = watcher.flow.latency
    mine = {
        "n": watcher.pictures,
        "latency": None if latency is None else round(latency * 1e3, 1),
        "size": shot.size,
        "quantiser": shot.quantiser,
    }
    text = json.dumps(head | mine, separators=(",", ":")).encode()
    return struct.pack("<I", len(text)) + text + jpeg
