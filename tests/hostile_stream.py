"""A stream of 60 frames a second with everything mixed in that a hostile sender has, on a stepped clock."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np

from cap4d.drive.clip import Frame
from cap4d.drive.counts import Histogram
from cap4d.drive.gate import Gate
from cap4d.drive.live import LiveStream
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.drive.wire import MAX_LINE, LineSplitter, format_packet

RATE = 60.0
ZEROS = np.zeros(3, np.float32)
SIZE = 65
"""Expressions of a frame."""


class OwnRig:
    """Takes expressions of the rig `tiny`."""

    def __call__(self, packet: Packet) -> Frame:
        if packet.rig_name != "tiny" or packet.expr is None:
            raise Rejected(Cause.RIG)
        return Frame(packet.t, "tiny", packet.expr, ZEROS, ZEROS, ZEROS)

    def neutral(self) -> Frame:
        return Frame(0.0, "tiny", np.zeros(SIZE, np.float32), ZEROS, ZEROS, ZEROS)


class _Nobody:
    address = "hostile://"

    def run(self, sink, stop) -> None:
        stop.wait()


@dataclass
class Slice:
    """A stretch of it: its end (s), blocks of memory Python holds then, latencies (s), share that flowed."""

    at: float
    blocks: int
    median: float
    p95: float
    flowing: float


@dataclass
class Outcome:
    """What came of it.

    Args:
        statistics: Of the stream.
        sent: Lines in all.
        expected: Those that had to be refused, by cause.
        slices: Of equal length.
        steepest: The largest change of any weight from picture to picture.
    """

    statistics: dict
    sent: int
    expected: Counter[str]
    slices: list[Slice]
    steepest: float


class HostileHour:
    """The senders and the player of one run.

    Lines go the way of a socket's bytes: `LineSplitter`, `Gate`, `LiveStream`. The hostile sender
    breaks into the honest one's connection, and tries connections of its own.

    Args:
        seed: Of everything that is drawn.
        floods: Whether there are any: what is refused in one is not refused for what else is wrong with it.
    """

    def __init__(self, *, seed: int = 0, floods: bool = True) -> None:
        self.floods = floods
        self.rng, self.now, self.offset = np.random.default_rng(seed), 0.0, 0.0
        self.stream = LiveStream(_Nobody(), OwnRig(), clock=lambda: self.now)
        self.gate, self.splitter = Gate(self.stream), LineSplitter()
        self.sent, self.expected = 0, Counter()
        self.latencies, self.flowing, self.pictures, self.steepest = Histogram(), 0, 0, 0.0
        self._last: np.ndarray | None = None

    def run(self, seconds: float, *, slices: int = 12) -> Outcome:
        """Plays so many seconds of stream."""
        found, every = [], int(seconds * RATE / slices)
        for i in range(slices * every):
            self.now = i / RATE
            self._honest(i)
            self._hostile()
            self._look()
            if (i + 1) % every == 0:
                found.append(self._slice())
        return Outcome(self.stream.statistics(), self.sent, self.expected, found, self.steepest)

    def _honest(self, i: int) -> None:
        """One frame, a little late; in a thousand one is lost, in ten thousand the clock jumps."""
        if self.rng.random() < 1e-4:
            self.offset += float(self.rng.choice([-3600.0, -5.0, 2.0, 1e6]))
        if self.rng.random() > 1e-3:
            t = i / RATE
            expr = np.sin(3 * t + np.arange(SIZE)).astype(np.float32)
            self.now += float(self.rng.uniform(0, 2e-3))
            self._say(format_packet(Packet(t + self.offset, "tiny", expr=expr)))

    def _hostile(self) -> None:
        """Now and then one of many bad things."""
        if self.rng.random() < 0.1:
            name = str(self.rng.choice(list(self._TRICKS)))
            self._TRICKS[name](self)

    def _garbage(self) -> None:
        for _ in range(3):
            noise = bytes(b for b in self.rng.bytes(60) if b not in b"\n\r \t\x0b\x0c") or b"x"
            self._say(b"\x01" + noise + b"\n", "syntax")

    def _giant(self) -> None:
        if self.rng.random() < 0.02:  # it takes long to make them
            self._say(b"[" * (MAX_LINE + 100) + b"\n", "size")
        self._say(b"0," * 6000 + b"0\n", "size")

    def _poison(self) -> None:
        self._say(b'{"t": %f, "rig": "tiny", "expr": [NaN]}\n' % self.now, "not_finite")
        self._say(b'{"t": %f, "rig": "tiny", "expr": [1e999]}\n' % self.now, "not_finite")
        self._say(b'{"t": NaN, "rig": "tiny", "expr": [1]}\n', "time")

    def _wrong(self) -> None:
        expr = np.zeros(SIZE, np.float32)
        self._say(format_packet(Packet(self.now + self.offset, "other", expr=expr)), "rig")
        self._say(format_packet(Packet(self.now + self.offset, "tiny", expr=expr[:7])), "shape")
        self._say(b'{"t": 1, "rig": "tiny"}\n', "field")

    def _flood(self) -> None:
        if self.floods and self.rng.random() < 0.05:
            for _ in range(400):
                self._say(b"!\n", "flood")

    def _intruder(self) -> None:
        line = format_packet(Packet(self.now, "tiny", expr=np.full(SIZE, 9, np.float32)))
        self.sent += 1
        self.expected["sender"] += 1
        self.gate.line(("intruder", int(self.rng.integers(1 << 30))), line.strip(), self.now)

    def _misdated(self) -> None:
        """A stamp from far off."""
        expr = np.full(SIZE, 9, np.float32)
        self._say(format_packet(Packet(self.now + self.offset + 777.0, "tiny", expr=expr)), "time")

    _TRICKS = {  # noqa: RUF012  a table, not a state
        "garbage": _garbage,
        "giant": _giant,
        "poison": _poison,
        "wrong": _wrong,
        "flood": _flood,
        "intruder": _intruder,
        "misdated": _misdated,
    }

    def _say(self, data: bytes, cause: str = "") -> None:
        """Into the honest sender's connection."""
        self.sent += 1
        if cause:
            self.expected[cause] += 1
        for line in self.splitter.feed(data):
            self.gate.line("honest", line, self.now)

    def _look(self) -> None:
        """A picture, 8 ms after the frame."""
        now = self.now + 8e-3
        frame = self.stream.frame(now)
        moment = self.stream._moment
        if moment is not None and moment.flows:
            self.latencies.add(now - moment.arrival)
        self.stream.shown(now)
        self.pictures += 1
        self.flowing += self.stream.state == "playing"
        assert np.isfinite(frame.expr).all()
        if self._last is not None:
            self.steepest = max(self.steepest, float(np.abs(frame.expr - self._last).max()))
        self._last = frame.expr

    def _slice(self) -> Slice:
        found = Slice(
            self.now,
            sys.getallocatedblocks(),
            self.latencies.percentile(50),
            self.latencies.percentile(95),
            self.flowing / self.pictures,
        )
        self.latencies, self.flowing, self.pictures = Histogram(), 0, 0
        return found
