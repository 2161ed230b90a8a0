"""Frames that come by themselves, played on the display's clock: what a window asks for its face."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from cap4d.drive.clip import Frame
from cap4d.drive.counts import Counts, Histogram
from cap4d.drive.ease import Ease, State
from cap4d.drive.jitter_buffer import JitterBuffer, Moment
from cap4d.drive.packet import Cause, Packet, Receiver, Rejected
from cap4d.errors import Cap4dError

log = logging.getLogger(__name__)

RETRY_SECONDS = 1.0  # until a receiver that failed is tried again
STOP_SECONDS = 1.0  # that a receiver gets to end
MAX_DETAIL = 256  # characters of it in a log line

Fill = Callable[[Frame, float], Frame]
"""(frame, now) -> the frame with what its source lacks: blinks, gaze, a breathing neck."""


class Convert(Protocol):
    """Packets -> frames of the avatar's own rig."""

    def __call__(self, packet: Packet) -> Frame:
        """Raises Rejected where there is no way."""

    def neutral(self) -> Frame:
        """The face at rest."""


class LiveStream:
    """A receiver, and the buffer between it and a display. A context manager; it is the receiver's `Sink`.

    `frame`, `shown`, `statistics` and `state` are for one thread, the display's; they neither wait nor raise.

    Args:
        receiver: Runs in a thread of its own.
        convert: What makes frames of packets; called in the receiver's thread.
        fill: What adds what the source lacks, or None; called by `frame`.
        clock: s that only go forward, the one `now` and arrivals are on.
    Attributes:
        error: Why the receiver gave up, if it did.
    """

    def __init__(
        self,
        receiver: Receiver,
        convert: Convert,
        fill: Fill | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.receiver, self.clock, self.error = receiver, clock, None
        self._convert, self._fill = convert, fill
        self._counts, self._latencies = Counts(), Histogram()
        self._buffer, self._ease = JitterBuffer(self._counts), Ease(convert.neutral())
        self._lock = threading.Lock()  # of the buffer
        self._stop, self._thread = threading.Event(), None
        self._moment: Moment | None = None
        self._interpolated = self._held = self._frames = 0
        self._last_arrival = float("-inf")
        self._told: set[Cause] = set()
        self._shape = self._ease.follow(None, 0.0).expr.shape

    def __enter__(self) -> LiveStream:
        self._thread = threading.Thread(target=self._receive, name=self.receiver.address, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(STOP_SECONDS)

    @property
    def address(self) -> str:
        """What to show: `tcp://127.0.0.1:9000`."""
        return self.receiver.address

    @property
    def state(self) -> State:
        """Of the last `frame`: waiting, playing, holding, easing."""
        return self._ease.state

    @property
    def ended(self) -> bool:
        """Whether nothing can come any more, and what came was played."""
        if self._thread is None or self._thread.is_alive() or self.state != "waiting":
            return False
        with self._lock:
            return not self._buffer.waiting

    def frame(self, now: float) -> Frame:
        """The face to show at `now` s."""
        with self._lock:
            self._moment = self._buffer.sample(now)
        frame = self._ease.follow(self._moment, now)
        self._frames += 1
        self._interpolated += self._moment is not None and self._moment.mixed
        self._held += self.state == "holding"
        if self._fill is None:
            return frame
        try:
            return self._fill(frame, now)
        except Exception:
            log.exception("%s: what the source lacks could not be added", self.address)
            self._fill = None
            return frame

    def shown(self, now: float) -> None:
        """The picture of the last `frame` is on screen."""
        moment, self._moment = self._moment, None
        if moment is not None and moment.flows:
            self._latencies.add(now - moment.arrival)

    def statistics(self) -> dict[str, Any]:
        """What became of the frames, and how old the pictures were; see the entries' names.

        `received` = `shown` + `dropped` + `waiting` + the sum of `rejected`. `late` frames came after their
        moment: refused, or, where nothing newer was there, shown all the same. `frames`, `interpolated` and
        `held` count pictures. `latency_ms` is the age of a picture's content: from its arrival, between those
        of the two frames around it, to `shown`.
        """
        with self._lock:
            buffer, rejected = self._buffer, self._counts.by_cause()
            return {
                "source": self.address,
                "connected": bool(self.clock() - self._last_arrival < 1.0),
                "state": self.state,
                "received": self._counts.received,
                "shown": buffer.shown,
                "dropped": buffer.dropped,
                "waiting": buffer.waiting,
                "late": int(buffer.overdue) + rejected.get(Cause.LATE, 0),
                "rejected": rejected,
                "frames": self._frames,
                "interpolated": self._interpolated,
                "held": self._held,
                "clock_jumps": max(buffer.clocks - 1, 0),
                "depth_ms": round(1e3 * float(buffer.depth), 2),
                "jitter_ms": round(1e3 * float(buffer.transit.jitter), 2),
                "rate": round(1 / buffer.transit.interval, 2) if buffer.clocks else 0.0,
                "latency_ms": {
                    name: round(1e3 * self._latencies.percentile(percent), 2)
                    for name, percent in (("median", 50), ("p95", 95), ("p99", 99))
                },
            }

    def packet(self, packet: Packet, arrival: float) -> bool:
        """As a sink: takes a frame in."""
        try:
            frame = self._sound(self._convert(packet))
        except Rejected as error:
            self.rejected(error.cause, error.detail)
            return False
        except Exception:
            log.debug("%s: no frame could be made of a packet", self.address, exc_info=True)
            self.rejected(Cause.INTERNAL, "no frame could be made of it")
            return False
        with self._lock:
            self._counts.receive()
            self._last_arrival = max(self._last_arrival, arrival)
            self._buffer.push(frame, arrival, max(arrival, self.clock()))
        return True

    def rejected(self, cause: Cause, detail: str = "", *, times: int = 1) -> None:
        """As a sink: a frame was refused before it got here, or so many."""
        self._counts.reject(cause, times=times)
        self._tell(cause, detail)

    def _tell(self, cause: Cause, detail: str) -> None:
        """One line for the first frame of each cause; the counts say the rest."""
        if cause not in self._told:
            self._told.add(cause)
            told = f": {_printable(detail)}" if detail else ""
            log.warning("%s: a frame was refused: %s%s", self.address, cause, told)

    def _sound(self, frame: Frame) -> Frame:
        if frame.expr.shape != self._shape:
            raise Rejected(Cause.SHAPE, f"expr: expected {self._shape[0]} numbers, got {frame.expr.shape}")
        parts = (frame.expr, frame.eye_rot, frame.neck_rot, frame.jaw_rot, frame.rot, frame.tra)
        if not all(part is None or np.isfinite(part).all() for part in parts):
            raise Rejected(Cause.NOT_FINITE)
        return frame

    def _receive(self) -> None:
        """The receiver's thread."""
        while not self._stop.is_set():
            try:
                self.receiver.run(self, self._stop)
                return
            except Cap4dError as error:
                self.error = error
                log.warning("%s", error)
                return
            except Exception:
                log.exception("%s: the receiver failed and is started again", self.address)
                self._stop.wait(RETRY_SECONDS)


def _printable(text: str) -> str:
    """Strangers' words for a log line: not too many, and no control characters, which a terminal obeys."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text[:MAX_DETAIL])
