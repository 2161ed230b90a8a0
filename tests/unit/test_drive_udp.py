"""Lines in datagrams through real sockets: who may send, and what is counted."""

from __future__ import annotations

import os
import time

from receiving import PATIENCE, datagrams, line, running, until_heard

from cap4d.drive.udp import UdpReceiver


def test_udp_takes_frames_and_counts_what_is_none() -> None:
    receiver = UdpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, datagrams(receiver) as send:
        for data in (line(1.0), b"", b"\xff" * 60_000, line(2.0) + line(3.0), line(4.0)[:20], line(5.0)):
            send(data)
        sink.until(lambda: len(sink.packets) == 4)
        assert sink.stamps() == [1, 2, 3, 5] and sink.causes == {"syntax": 2}


def test_udp_one_address_rules_until_it_is_silent_for_a_second() -> None:
    receiver = UdpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, datagrams(receiver) as first, datagrams(receiver) as second:
        first(line(1.0))
        sink.until(lambda: sink.stamps() == [1.0])
        second(line(9.0))
        sink.until(lambda: sink.causes == {"sender": 1})
        end = time.monotonic() + PATIENCE
        while len(sink.packets) == 1:
            assert time.monotonic() < end
            second(line(9.0))
            time.sleep(0.05)
        assert 1.0 < sink.arrivals[1] - sink.arrivals[0] < 2.0


def test_udp_asks_for_the_token_in_every_datagram() -> None:
    receiver = UdpReceiver("127.0.0.1", 0, token="secret")
    with running(receiver) as sink, datagrams(receiver) as send:
        for data in (line(1.0), line(2.0, token="guess"), line(3.0, token="secret"), line(4.0)):
            send(data)
        sink.until(lambda: sink.causes["token"] == 3)
        assert sink.stamps() == [3.0]


def test_udp_a_datagram_of_many_lines_is_left_at_the_first_too_many() -> None:
    receiver = UdpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, datagrams(receiver) as send:
        send(b"x\n" * 30_000)
        sink.until(lambda: sum(sink.causes.values()) == 30_000)
        assert sink.causes["flood"] > 29_000 and sink.refusals < 1000


def test_udp_a_flood_is_cut_even_where_the_system_drops_it() -> None:
    receiver = UdpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, datagrams(receiver) as send:
        sent, end = 0, time.monotonic() + 1
        while time.monotonic() < end:
            send(b"not json" * 100)
            sent += 1
        time.sleep(0.3)
        send(line(1.0))
        end = time.monotonic() + PATIENCE
        while not sink.packets:
            assert time.monotonic() < end
            send(line(1.0))
            time.sleep(0.05)
        assert sink.causes["flood"] > 100 and sink.causes["syntax"] < 1000
        if os.uname().sysname == "Linux" and "flood" in sink.causes:
            assert sum(sink.causes.values()) >= 0.99 * sent  # what the kernel dropped is counted too


def test_udp_can_be_run_again() -> None:
    receiver = UdpReceiver("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink, datagrams(receiver) as send:
        until_heard(sink, lambda: send(line(1.0)), lambda: sink.packets)
