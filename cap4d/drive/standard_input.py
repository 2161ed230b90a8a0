"""Frames on standard input: a line of JSON a frame (`wire`); a file poured in plays at its own speed."""

from __future__ import annotations

import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from cap4d.drive.gate import Gate
from cap4d.drive.pace import Pace
from cap4d.drive.packet import Cause, Sink
from cap4d.drive.wire import LineSplitter

READ = 1 << 16  # bytes at once
POLL = 0.1  # s
FLOODED = 20e-3  # s


class StandardInputReceiver:
    """Whatever file descriptor standard input is; ends with it. See `packet.Receiver`.

    Args:
        file: The descriptor; None for standard input's.
    """

    address = "-"

    def __init__(self, file: int | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._file, self._clock = sys.stdin.fileno() if file is None else file, clock

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `packet.Receiver`."""
        gate, pace, splitter = Gate(sink), Pace(), LineSplitter()
        for data in self._chunks(stop):
            lines = deque(splitter.feed(data))
            while lines and not stop.is_set():
                now = self._clock()
                t = gate.line(self, lines.popleft(), now)
                if t is not None and (lead := pace.lead(t, now)) and (lines or self._has_more(0.0)):
                    stop.wait(lead)
                elif gate.flooded:
                    sink.rejected(Cause.FLOOD, times=len(lines))
                    lines.clear()
                    stop.wait(FLOODED)

    def _chunks(self, stop: threading.Event) -> Iterator[bytes]:
        while not stop.is_set():
            if self._has_more(POLL):
                data = os.read(self._file, READ)
                yield data or b"\n"
                if not data:
                    return

    def _has_more(self, timeout: float) -> bool:
        """Whether reading would not wait. Windows cannot tell: there the thread waits."""
        return os.name != "posix" or bool(select.select([self._file], [], [], timeout)[0])
