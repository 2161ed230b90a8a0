"""Lines over TCP through real sockets: who may send, what is counted, what ends and what does not."""

from __future__ import annotations

import json
import time
from contextlib import suppress

import numpy as np
import pytest
from receiving import PATIENCE, closed, connect, line, port_of, running

from cap4d.drive import tcp
from cap4d.drive.packet import Receiver
from cap4d.drive.tcp import TcpReceiver
from cap4d.drive.wire import MAX_LINE, format_token
from cap4d.errors import ArgumentError


def test_tcp_takes_frames_however_they_are_cut_up() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, connect(receiver) as sender:
        data = b"".join(line(i / 60) for i in range(20))
        for at in range(0, len(data), 37):
            sender.sendall(data[at : at + 37])
        sink.until(lambda: len(sink.packets) == 20)
        np.testing.assert_allclose(sink.stamps(), np.arange(20) / 60)
        assert not sink.causes


def test_tcp_goes_on_after_garbage_and_after_the_sender_comes_back() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink:
        for t in (1.0, 2.0, 3.0):
            with connect(receiver) as sender:
                sender.sendall(b"\x00\xff garbage\n\n{}\n" + line(t) + line(t, rig="other") + b'{"t": 1, "ex')
                sink.until(lambda t=t: len(sink.packets) == t)
            sink.until(lambda t=t: sink.causes["syntax"] == 2 * t)
        assert sink.stamps() == [1, 2, 3] and sink.causes == {"syntax": 6, "field": 3, "rig": 3}


def test_tcp_counts_a_giant_line_once_and_reads_on() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, connect(receiver) as sender:
        sender.sendall(b"x" * (3 * MAX_LINE) + b"\n" + line(5.0))
        sink.until(lambda: len(sink.packets) == 1)
        assert sink.causes == {"size": 1}


def test_tcp_one_sender_rules_until_it_hangs_up() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink:
        with connect(receiver) as first, connect(receiver) as second:
            first.sendall(line(1.0))
            sink.until(lambda: len(sink.packets) == 1)
            second.sendall(line(99.0))
            assert "another one sends" in json.loads(closed(second))["error"]
            first.sendall(line(2.0))
            sink.until(lambda: len(sink.packets) == 2)
        with connect(receiver) as third:
            third.sendall(line(3.0))
            sink.until(lambda: len(sink.packets) == 3)
        assert sink.stamps() == [1, 2, 3] and sink.causes == {"sender": 1}


def test_tcp_a_sender_of_what_the_avatar_cannot_use_keeps_nobody_out() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, connect(receiver) as wrong, connect(receiver) as right:
        wrong.sendall(line(1.0, rig="other"))
        sink.until(lambda: sink.causes["rig"] == 1)
        right.sendall(line(2.0))
        sink.until(lambda: sink.stamps() == [2.0])


def test_tcp_asks_for_the_token_first() -> None:
    receiver = TcpReceiver("127.0.0.1", 0, token="secret")
    with running(receiver) as sink:
        for wrong in (line(1.0), format_token("guess") + line(1.0), b"garbage\n", b"x" * 2 * MAX_LINE):
            with connect(receiver) as sender:
                with suppress(ConnectionResetError, BrokenPipeError):
                    sender.sendall(wrong)
                closed(sender)
        assert sum(sink.causes.values()) == 4 and not sink.packets
        with connect(receiver) as sender:
            sender.sendall(format_token("secret") + line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])


def test_tcp_connections_that_say_nothing_are_hung_up_on(monkeypatch) -> None:
    monkeypatch.setattr(tcp, "GREETING", 0.2)
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink:
        crowd = [connect(receiver) for _ in range(tcp.MAX_CONNECTIONS + 3)]
        for sock in crowd:
            sock.send(b"{")
        for sock in crowd:
            closed(sock)
            sock.close()
        sink.until(lambda: sink.causes["sender"] == len(crowd))
        with connect(receiver) as sender:
            sender.sendall(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])


def test_tcp_connections_are_limited(monkeypatch) -> None:
    monkeypatch.setattr(tcp, "GREETING", 10 * PATIENCE)  # after it all are hung up on
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink:
        crowd = [connect(receiver) for _ in range(tcp.MAX_CONNECTIONS + 3)]
        for sock in crowd[tcp.MAX_CONNECTIONS :]:
            closed(sock)
        sink.until(lambda: sink.causes == {"sender": 3})
        for sock in crowd:
            sock.close()


def test_tcp_a_flood_is_cut_and_the_work_bounded() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, connect(receiver) as sender:
        sender.settimeout(0.2)
        flood, used, end = b"not json\n" * 5000, time.process_time(), time.monotonic() + 1
        while time.monotonic() < end:
            try:
                sender.send(flood)
            except TimeoutError:
                continue
        used = time.process_time() - used
        assert sink.causes["flood"] > 1000 and sink.causes["syntax"] < 1000
        assert used < 0.5  # s of a second, the sender's share among them


def test_tcp_a_flood_of_blank_lines_is_one() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, connect(receiver) as sender:
        sender.sendall(b"\n" * 60_000)
        sink.until(lambda: sink.causes["flood"] > 50_000)


def test_tcp_a_file_poured_in_plays_at_its_own_speed() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver) as sink, connect(receiver) as sender:
        sender.sendall(b"".join(line(i / 100) for i in range(100)))
        sink.until(lambda: len(sink.packets) == 100)
        took = np.array(sink.arrivals) - sink.arrivals[0]
        assert np.abs(took - np.arange(100) / 100).max() < 0.15
        assert took[-1] > 0.9


def test_tcp_an_address_in_use_is_an_argument_error() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver), pytest.raises(ArgumentError, match="expected to listen"):
        TcpReceiver("127.0.0.1", port_of(receiver))
    with pytest.raises(ArgumentError, match="expected to listen"):
        TcpReceiver("256.1.1.1", 0)


def test_tcp_can_be_run_again() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink:
        sink.until(lambda: can_connect(receiver))
        with connect(receiver) as sender:
            sender.sendall(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])


def can_connect(receiver: Receiver) -> bool:
    try:
        connect(receiver).close()
    except ConnectionRefusedError:
        return False
    return True
