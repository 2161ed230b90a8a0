"""`cap4d drive`: a source on the wire, in real time, to a viewer that may come and go."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue
from typing import BinaryIO, Protocol

from cap4d.drive.impair import BadLine, Impairment, line_noise, noise, parse_impairment
from cap4d.drive.livelink_format import format_livelink
from cap4d.drive.packet import Packet, Rejected
from cap4d.drive.recording import Form, Recording, open_recording
from cap4d.drive.target import Target, open_target, token_of
from cap4d.drive.wire import MAX_LINE, format_packet, parse_packet
from cap4d.errors import ArgumentError

log = logging.getLogger(__name__)

PROGRESS_SECONDS = 2.0  # between lines of progress
LONGEST_NAP = 0.5  # s; what is shown meanwhile stays fresh
CONNECT_NAP = 0.05  # s
QUEUE = 64  # lines read ahead of standard input
STDIN_RATE = 1 / 30  # s; what `reorder` takes for a frame of lines that come by themselves

Format = Callable[[Packet], bytes]


class Source(Protocol):
    """Messages, each at its time."""

    done: bool

    def take(self, now: float) -> list[tuple[float, bytes]]:
        """(its moment, the message) of all that are due at `now` s."""

    def due(self) -> float:
        """When the next one is; infinity: it comes by itself."""

    def wait(self, seconds: float) -> None:
        """Sleeps that long, or until something has come by itself."""


class RecordedSource:
    """A recording's messages; its clock starts with the first call.

    Args:
        recording: What to send.
        form: A packet as a message.
        speed: Times as fast as it was recorded.
        loop: Again and again. The stream's clock goes on.
        sleep: As `time.sleep`.
    """

    def __init__(
        self,
        recording: Recording,
        form: Format,
        *,
        speed: float = 1.0,
        loop: bool = False,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.recording, self.form, self.loop, self.wait = recording, form, loop, sleep
        self.frame_time = 1 / (recording.fps * speed)
        self._start: float | None = None
        self._next = 0

    @property
    def done(self) -> bool:
        return not self.loop and self._next >= self.recording.count

    def take(self, now: float) -> list[tuple[float, bytes]]:
        """See `Source`."""
        if self._start is None:
            self._start = now
        messages = []
        while not self.done and self.due() <= now:
            packet = self.recording.packet(self._next % self.recording.count, self._next * self.frame_time)
            messages.append((self.due(), self.form(packet)))
            self._next += 1
        return messages

    def due(self) -> float:
        """See `Source`."""
        return self._start + self._next * self.frame_time


class LineSource:
    """Lines that come by themselves, passed on as they are; those that are too long are left out.

    Args:
        stream: Read by a thread of its own, and no faster than lines are taken.
        form: A line as a message, or None for one that cannot be.
    """

    frame_time = STDIN_RATE

    def __init__(self, stream: BinaryIO, form: Callable[[bytes], bytes | None]) -> None:
        self.form, self.done, self.refused = form, False, 0
        self._lines: Queue[bytes] = Queue(QUEUE)
        self._came = threading.Event()
        self._ended = False
        threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def take(self, now: float) -> list[tuple[float, bytes]]:
        """See `Source`."""
        self._came.clear()
        ended, messages = self._ended, []
        while True:
            try:
                message = self.form(self._lines.get_nowait())
            except Empty:
                self.done = ended
                return messages
            if message is None:
                self.refused += 1
            else:
                messages.append((now, message))

    def due(self) -> float:
        """See `Source`."""
        return float("inf")

    def wait(self, seconds: float) -> None:
        """See `Source`."""
        self._came.wait(seconds)

    def _read(self, stream: BinaryIO) -> None:
        while line := stream.readline(MAX_LINE):
            if not line.endswith(b"\n") and len(line) == MAX_LINE:
                _pass_over(stream)
                self.refused += 1
                continue
            self._lines.put(line if line.endswith(b"\n") else line + b"\n")
            self._came.set()
        self._ended = True
        self._came.set()


def _pass_over(stream: BinaryIO) -> None:
    """The rest of a line."""
    while (rest := stream.readline(MAX_LINE)) and not rest.endswith(b"\n"):
        pass


class Sender:
    """Takes messages from a source over a bad line to a target.

    Args:
        clock: s, only goes forward.
        sleep: Waits for that clock.
    Attributes:
        sent, unheard: Messages that went out, and that nobody was there for.
    """

    def __init__(
        self,
        source: Source,
        line: BadLine,
        target: Target,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.source, self.line, self.target, self.clock, self.sleep = source, line, target, clock, sleep
        self.sent = self.unheard = 0
        self._told = (-1e9, 0)  # when progress was, and `sent` then

    def run(self) -> None:
        """Until the source ends. The first message waits for the viewer; later ones do not.

        Raises:
            ArgumentError: A message is too large for the target.
        """
        try:
            self._connect()
            while not self._over():
                self._pass_on(self.clock())
                self._progress(self.clock())
                if not self._over():
                    self.source.wait(self._nap(self.clock()))
        finally:
            self.target.close()

    def summary(self) -> str:
        """What was sent, and what was not."""
        counts = Counter(self.line.counts)
        counts["refused"] = getattr(self.source, "refused", 0)
        words = [f"{counts[name]} {name}" for name in ("lost", "held", "doubled", "garbage") if counts[name]]
        purpose = f"; on purpose: {', '.join(words)}" if words else ""
        refused = f"; {counts['refused']} refused" if counts["refused"] else ""
        unheard = f"; {self.unheard} with nobody there" if self.unheard else ""
        again = f"; connected {self.target.connections} times" if self.target.connections > 1 else ""
        return f"{self.sent} sent{purpose}{refused}{unheard}{again}"

    def _connect(self) -> None:
        while not self.target.connected(now := self.clock()):
            if now - self._told[0] >= PROGRESS_SECONDS:
                log.info("%s: waiting for the viewer (%s)", self.target.address, self.target.reason)
                self._told = (now, 0)
            self.sleep(CONNECT_NAP)
        self._told = (self.clock(), 0)

    def _over(self) -> bool:
        return self.source.done and self.line.due() == float("inf")

    def _pass_on(self, now: float) -> None:
        for at, message in self.source.take(now):
            if len(message) > self.target.largest:
                raise ArgumentError(
                    f"to: a frame of {len(message)} bytes does not fit into a datagram "
                    f"({self.target.largest}): use tcp:// or ws://, or send it --as expr"
                )
            self.line.put(message, at)
        for message in self.line.take(now):
            heard = self.target.send(message, self.clock())
            self.sent, self.unheard = self.sent + heard, self.unheard + (not heard)

    def _nap(self, now: float) -> float:
        return min(max(min(self.source.due(), self.line.due()) - now, 0.0), LONGEST_NAP)

    def _progress(self, now: float) -> None:
        then, before = self._told
        if now - then >= PROGRESS_SECONDS:
            rate = (self.sent - before) / (now - then)
            log.info("%s: %.1f a second; %s", self.target.address, rate, self.summary())
            self._told = (now, self.sent)


@dataclass(frozen=True)
class Transmission:
    """What to send, where to, and how.

    Args:
        source: A file, see `open_recording`, or `-`: lines of standard input, passed on as they are.
        to: See `open_target`.
        impair: See `parse_impairment`.
        form, avatar, template, fps: See `open_recording`.
        speed: Times as fast as it was recorded.
        loop: Until interrupted.
        token: What the viewer asks for.
        seed: Of the impairments.
    """

    source: str
    to: str
    impair: str | None = None
    form: Form | None = None
    avatar: Path | None = None
    template: Path | None = None
    fps: float | None = None
    speed: float = 1.0
    loop: bool = False
    token: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("fps", "speed"):
            if (value := getattr(self, name)) is not None and not 0 < value <= 1000:
                raise ArgumentError(f"{name}: expected a number in (0, 1000], got {value:g}")
        if self.seed < 0:
            raise ArgumentError(f"seed: expected 0 or more, got {self.seed}")


def send(wanted: Transmission) -> None:
    """Sends a source to a viewer, in real time.

    Raises:
        ArgumentError, DataError: What is wanted makes no sense, or a file is not sound.
    """
    impairment = Impairment() if wanted.impair is None else parse_impairment(wanted.impair)
    target = open_target(wanted.to, token=wanted.token)
    source = _line_source(wanted) if wanted.source == "-" else _recorded_source(wanted)
    garbage = noise if _is_livelink(wanted) else line_noise
    line = BadLine(impairment, seed=wanted.seed, frame_time=source.frame_time, garbage=garbage)
    sender = Sender(source, line, target)
    try:
        sender.run()
    finally:
        if target.connections:
            log.info("%s: %s", target.address, sender.summary())


def _recorded_source(wanted: Transmission) -> RecordedSource:
    livelink = _is_livelink(wanted)
    recording = open_recording(
        wanted.source,
        form="arkit" if livelink and wanted.form is None else wanted.form,
        avatar=wanted.avatar,
        template=wanted.template,
        fps=wanted.fps,
    )
    if livelink and recording.form != "arkit":
        raise ArgumentError(f"as: Live Link Face carries ARKit's weights, got {recording.form}")
    return RecordedSource(recording, _format(wanted), speed=wanted.speed, loop=wanted.loop)


def _line_source(wanted: Transmission) -> LineSource:
    if wanted != Transmission("-", wanted.to, wanted.impair, token=wanted.token, seed=wanted.seed):
        raise ArgumentError("drive: lines of standard input (-) are passed on when they come and as they are")
    form = _format(wanted)
    if not _is_livelink(wanted) and token_of(wanted.to, wanted.token) is None:
        return LineSource(sys.stdin.buffer, bytes)
    return LineSource(sys.stdin.buffer, lambda line: _reformat(line, form))


def _is_livelink(wanted: Transmission) -> bool:
    return wanted.to.startswith("livelink://")


def _format(wanted: Transmission) -> Format:
    if _is_livelink(wanted):
        return format_livelink
    token = token_of(wanted.to, wanted.token)
    return lambda packet: format_packet(packet, token=token)


def _reformat(line: bytes, form: Format) -> bytes | None:
    """A line as another message; None: it holds no frame, or none that can be said so."""
    try:
        packet = parse_packet(line)
    except Rejected:
        return None
    return None if form is format_livelink and packet.arkit is None else form(packet)
