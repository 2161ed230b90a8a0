"""Hostile senders: whatever they send, the player plays on, in the same memory, and counts it."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from urllib.parse import urlsplit

import numpy as np
from hostile_stream import HostileHour, OwnRig
from hypothesis import given, settings
from hypothesis import strategies as st

from cap4d.drive import tcp
from cap4d.drive.live import LiveStream
from cap4d.drive.packet import Packet, Rejected
from cap4d.drive.tcp import TcpReceiver
from cap4d.drive.wire import LineSplitter, format_packet, parse_packet

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
VALUE_KEYS = ("expr", "arkit", "vertices")
TURN_KEYS = ("eye_rot", "neck_rot", "jaw_rot", "rot", "tra")
KEYS = ("t", "rig", *VALUE_KEYS, *TURN_KEYS, "token")


def parse(line: bytes) -> Packet | None:
    """The frame; None where it is refused. Nothing else may happen."""
    try:
        return parse_packet(line)
    except Rejected:
        return None


def sound(packet: Packet) -> bool:
    arrays = [getattr(packet, name) for name in (*VALUE_KEYS, *TURN_KEYS)]
    values = sum(getattr(packet, name) is not None for name in VALUE_KEYS)
    return (
        values == 1
        and np.isfinite(packet.t)
        and all(a is None or (a.dtype == np.float32 and np.isfinite(a).all()) for a in arrays)
    )


@settings(max_examples=400, deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_do_more_than_be_refused(line) -> None:
    packet = parse(line)
    assert packet is None or sound(packet)


@settings(max_examples=400, deadline=None)
@given(st.dictionaries(st.sampled_from(KEYS), VALUES))
def test_no_json_does_more_than_be_refused(value) -> None:
    packet = parse(json.dumps(value).encode())
    assert packet is None or sound(packet)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_a_frame_with_bytes_changed_is_refused_or_sound(data) -> None:
    line = bytearray(format_packet(Packet(1.25, "tiny", expr=np.float32([0.5, -1e-3, 2.0]), rot=np.zeros(3))))
    for _ in range(data.draw(st.integers(1, 4))):
        line[data.draw(st.integers(0, len(line) - 1))] = data.draw(st.integers(0, 255))
    packet = parse(bytes(line))
    assert packet is None or sound(packet)


@given(st.lists(st.binary(max_size=30), max_size=20), st.integers(1, 40))
def test_the_cuts_between_reads_do_not_matter(parts, limit) -> None:
    whole, cut = LineSplitter(limit), LineSplitter(limit)
    data = b"".join(parts) + b"\n"
    assert list(whole.feed(data)) == [line for part in [*parts, b"\n"] for line in cut.feed(part)]
    assert len(cut._held) <= limit


def test_each_refused_line_is_counted_by_its_cause() -> None:
    outcome = HostileHour(floods=False).run(60)
    rejected = outcome.statistics["rejected"]
    assert outcome.statistics["received"] == outcome.sent
    assert rejected == dict(outcome.expected) and len(rejected) == 8


def test_two_hostile_minutes_leave_memory_and_latency_as_they_were() -> None:
    outcome = HostileHour().run(120)
    found, (first, *_, last) = outcome.statistics, outcome.slices[2:]
    fates = found["shown"] + found["dropped"] + found["waiting"] + sum(found["rejected"].values())
    assert found["received"] == outcome.sent == fates
    assert set(found["rejected"]) == set(outcome.expected)
    assert found["rejected"]["flood"] > 500 and found["clock_jumps"] >= 1
    assert last.blocks < 1.003 * first.blocks
    assert all(part.median < 0.022 and part.p95 < 0.04 and part.flowing > 0.95 for part in outcome.slices)
    assert outcome.steepest < 0.4  # a wave of 0.05 a picture; nobody's 9 was ever on screen


def test_a_crowd_of_hostile_connections_keeps_no_honest_one_out(monkeypatch) -> None:
    """Real sockets: half-open connections, garbage, giant lines and a flood, all at once."""
    monkeypatch.setattr(tcp, "GREETING", 0.3)
    receiver, stop = TcpReceiver("127.0.0.1", 0), threading.Event()
    port = urlsplit(receiver.address).port

    def attack(data: bytes, pause: float) -> None:
        while not stop.is_set():
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1) as sock:
                sock.settimeout(0.2)
                while not stop.wait(pause):
                    sock.sendall(data)
                    pause = max(pause, 0.01)

    attacks = [
        (b"{", 0.05),
        (b"{", 0.05),
        (b"\x00garbage\n", 0.01),
        (b"x" * (1 << 18), 0.02),
        (b"!\n" * 9999, 0.01),
    ]
    threads = [threading.Thread(target=attack, args=args) for args in attacks]
    with LiveStream(receiver, OwnRig()) as stream:
        for thread in threads:
            thread.start()
        try:
            sent = honest(port, stream, frames=60)
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        found = stream.statistics()
    fates = found["shown"] + found["dropped"] + found["waiting"] + sum(found["rejected"].values())
    taken = fates - sum(found["rejected"].values()) + found["rejected"].get("late", 0)
    assert taken == sent and fates == found["received"]
    assert found["rejected"]["sender"] > 0


def honest(port: int, stream: LiveStream, *, frames: int) -> int:
    """Sends frames, waiting for each to arrive; comes back when it is refused at the door."""
    expr, sent, end = np.zeros(65, np.float32), 0, time.monotonic() + 20
    while sent < frames:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1) as sock:
            while sent < frames:
                before = _taken(stream)
                sock.sendall(format_packet(Packet(time.monotonic(), "tiny", expr=expr)))
                patience = time.monotonic() + 0.5
                while _taken(stream) == before and time.monotonic() < patience:
                    time.sleep(1e-3)
                if _taken(stream) == before:
                    break
                sent += 1
                stream.frame(time.monotonic())
        assert time.monotonic() < end, stream.statistics()
    return sent


def _taken(stream: LiveStream) -> int:
    found = stream.statistics()
    return found["shown"] + found["dropped"] + found["waiting"] + found["rejected"].get("late", 0)
