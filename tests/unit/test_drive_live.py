"""A live stream from packets to pictures, on a clock of the test's own."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from cap4d.drive.clip import Frame
from cap4d.drive.counts import Counts, Histogram
from cap4d.drive.live import LiveStream
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.errors import ArgumentError

ZEROS = np.zeros(3, np.float32)


class Silent:
    """A receiver to which nothing comes."""

    address = "test://"

    def run(self, sink, stop) -> None:
        stop.wait()


class Own:
    """Takes expressions of the rig `tiny`."""

    def __call__(self, packet: Packet) -> Frame:
        if packet.rig_name == "bug":
            raise ZeroDivisionError
        if packet.rig_name != "tiny":
            raise Rejected(Cause.RIG, f"expected tiny, got {packet.rig_name}")
        return Frame(packet.t, "tiny", packet.expr, ZEROS, ZEROS, ZEROS)

    def neutral(self) -> Frame:
        return Frame(0.0, "tiny", np.zeros(2, np.float32), ZEROS, ZEROS, ZEROS)


def packet(t: float, value: float = 0.0, *, rig: str = "tiny", size: int = 2) -> Packet:
    return Packet(t, rig, expr=np.full(size, value, np.float32))


def stream(fill=None) -> LiveStream:
    return LiveStream(Silent(), Own(), fill, clock=lambda: 100.0)


def test_before_the_first_packet_the_face_is_neutral() -> None:
    live = stream()
    frame = live.frame(100.0)
    live.shown(100.0)
    assert not frame.expr.any() and live.state == "waiting"
    found = live.statistics()
    assert found["received"] == 0 and not found["connected"] and found["latency_ms"]["median"] == 0


def test_what_is_sent_is_shown_and_the_numbers_say_how() -> None:
    live = stream()
    shown = []
    for i in range(600):
        now = 100 + i / 60
        live.packet(packet(i / 60, i / 600), now)
        shown.append(live.frame(now + 0.004).expr[0])
        live.shown(now + 0.012)  # drawing takes 8 ms
    found = live.statistics()
    assert found["received"] == 600 == found["shown"] + found["dropped"] + found["waiting"]
    assert shown[-1] == pytest.approx(598.8 / 600, abs=2e-3)
    # a frame waits for the next (16.7 ms) and 2 ms more; then it is drawn
    assert found["latency_ms"]["median"] == pytest.approx(26.7, rel=0.03)
    assert found["latency_ms"]["p95"] < 40  # with the first second, which knows little
    assert found["depth_ms"] == pytest.approx(18.7, abs=0.1) and found["jitter_ms"] < 0.1
    assert found["rate"] == 60 and found["interpolated"] > 590 and found["held"] == 0


def test_a_slow_conversion_is_waited_for_and_is_part_of_the_latency() -> None:
    clock = [100.0]

    class Slow(Own):
        def __call__(self, packet: Packet) -> Frame:
            clock[0] += 0.02
            return super().__call__(packet)

    live = LiveStream(Silent(), Slow(), clock=lambda: clock[0])
    for i in range(300):
        arrival = clock[0] = 100 + i / 30
        live.packet(packet(i / 30), arrival)
        for tick in (0.021, 0.032):
            live.frame(arrival + tick)
            live.shown(arrival + tick)
    found = live.statistics()
    assert found["held"] == 0 and found["late"] == 0 and found["interpolated"] > 590
    assert found["latency_ms"]["median"] == pytest.approx(33.3 + 2 + 20, rel=0.03)


def test_every_refused_frame_is_counted_by_its_cause(caplog) -> None:
    live = stream()
    assert live.packet(packet(0.0), 100.0)
    assert not live.packet(packet(0.1, rig="other"), 100.1)
    assert not live.packet(packet(0.1, rig="bug"), 100.1)
    assert not live.packet(packet(0.1, size=3), 100.1)
    assert not live.packet(packet(0.1, np.nan), 100.1)
    assert live.packet(packet(0.0), 100.0)
    live.rejected(Cause.FLOOD, times=5)
    live.rejected(Cause.SYNTAX)
    causes = {"rig": 1, "internal": 1, "shape": 1, "not_finite": 1, "duplicate": 1, "flood": 5, "syntax": 1}
    found = live.statistics()
    assert found["rejected"] == causes
    assert found["received"] == 12 == sum(causes.values()) + found["waiting"] + found["shown"]
    live.rejected(Cause.FLOOD, "again")
    assert sum("flood" in line for line in caplog.messages) == 1  # the first of a cause is told of, no more


def test_strangers_words_are_told_without_control_characters_and_cut(caplog) -> None:
    live = stream()
    live.rejected(Cause.FIELD, "ä\x1b[2J\r\n\u202e\ud800" + 1_000_000 * "\x00")
    live.rejected(Cause.RIG, 1_000_000 * "x")
    first, second = caplog.messages
    assert r"field: ä\x1b[2J\r\n\u202e\ud800\x00" in first and first.isprintable()
    assert len(first) < 1200 and len(second) < 400


def test_what_fills_in_sees_frame_and_time_and_may_not_stop_the_show(caplog) -> None:
    def fill(frame: Frame, now: float) -> Frame:
        if now > 101:
            raise RuntimeError("no more")
        return Frame(frame.t, frame.rig_name, frame.expr + 7, ZEROS, ZEROS, ZEROS)

    live = stream(fill)
    assert live.frame(100.0).expr[0] == 7
    assert live.frame(102.0).expr[0] == 0 and "lacks" in caplog.text
    assert live.frame(102.0).expr[0] == 0


def test_a_receiver_that_cannot_start_is_told_of_and_the_face_stays() -> None:
    class Broken(Silent):
        def run(self, sink, stop) -> None:
            raise ArgumentError("drive: no such camera")

    with LiveStream(Broken(), Own()) as live:
        live._thread.join(5)
        assert "no such camera" in str(live.error)
        assert live.frame(time.monotonic()).rig_name == "tiny" and live.ended


def test_a_receiver_that_fails_is_started_again(monkeypatch) -> None:
    monkeypatch.setattr("cap4d.drive.live.RETRY_SECONDS", 0.0)
    again = threading.Event()

    class Failing(Silent):
        runs = 0

        def run(self, sink, stop) -> None:
            self.runs += 1
            if self.runs == 1:
                raise RuntimeError("the driver hung up")
            again.set()
            stop.wait()

    with LiveStream(Failing(), Own()) as live:
        assert again.wait(5) and live.error is None


def test_counts_and_percentiles_hold_in_constant_memory() -> None:
    counts, histogram = Counts(), Histogram()
    counts.reject(Cause.LATE)
    counts.reject(Cause.LATE, times=2)
    counts.reject(Cause.LATE, received=True)
    assert counts.received == 3 and counts.by_cause() == {"late": 4}
    seconds = np.random.default_rng(0).lognormal(-4, 0.5, 20_000)
    size = histogram._bins.nbytes
    for value in seconds:
        histogram.add(value)
    for percent in (5, 50, 95, 99):
        assert histogram.percentile(percent) == pytest.approx(np.percentile(seconds, percent), rel=0.03)
    for value in (0.0, -1.0, 1e9):
        histogram.add(value)
    assert len(histogram) == 20_003 and histogram._bins.nbytes == size
    assert Histogram().percentile(50) == 0
