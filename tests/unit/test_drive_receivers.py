"""Receivers through real sockets on loopback: who may send, what is counted, what ends and what does not."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

import numpy as np
import pytest

from cap4d.drive import tcp
from cap4d.drive.livelink import LiveLinkReceiver
from cap4d.drive.packet import Packet, Receiver
from cap4d.drive.standard_input import StandardInputReceiver
from cap4d.drive.tcp import TcpReceiver
from cap4d.drive.udp import UdpReceiver
from cap4d.drive.wire import MAX_LINE, format_packet, format_token
from cap4d.errors import ArgumentError

PATIENCE = 10.0  # s until a test gives up


class Kept:
    """A sink that keeps everything; frames of another rig than `tiny` are not its own."""

    def __init__(self) -> None:
        self.packets: list[Packet] = []
        self.arrivals: list[float] = []
        self.causes: Counter[str] = Counter()
        self.refusals = 0  # calls of `rejected`

    def packet(self, packet: Packet, arrival: float) -> bool:
        if packet.rig_name != "tiny":
            self.causes["rig"] += 1
            return False
        self.packets.append(packet)
        self.arrivals.append(arrival)
        return True

    def rejected(self, cause, detail="", *, times=1) -> None:
        self.causes[str(cause)] += times
        self.refusals += 1

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, (len(self.packets), self.causes)
            time.sleep(0.002)

    def stamps(self) -> list[float]:
        return [packet.t for packet in self.packets]


@contextmanager
def running(receiver: Receiver) -> Iterator[Kept]:
    """The receiver in its thread, which ends within half a second of being told."""
    sink, stop, failed = Kept(), threading.Event(), []

    def run() -> None:
        try:
            receiver.run(sink, stop)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield sink
    finally:
        stop.set()
        start = time.monotonic()
        thread.join(PATIENCE)
    assert not failed and not thread.is_alive()
    assert time.monotonic() - start < 1.0  # half a second on a machine that does nothing else


def line(t: float, *, rig: str = "tiny", token: str | None = None) -> bytes:
    return format_packet(Packet(t, rig, expr=np.float32([t])), token=token)


def port_of(receiver: Receiver) -> int:
    return urlsplit(receiver.address).port


def connect(receiver: Receiver) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port_of(receiver)), timeout=PATIENCE)


def closed(sock: socket.socket) -> str:
    """What the other side said before it hung up."""
    said = b""
    try:
        while data := sock.recv(1000):
            said += data
    except ConnectionResetError:
        pass
    return said.decode()


# TCP ----------------------------------------------------------------------------------------------


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


# UDP ----------------------------------------------------------------------------------------------


@contextmanager
def datagrams(receiver: Receiver) -> Iterator[Callable[[bytes], None]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield lambda data: sock.sendto(data, ("127.0.0.1", port_of(receiver)))


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


# standard input -----------------------------------------------------------------------------------


@contextmanager
def piped() -> Iterator[tuple[StandardInputReceiver, Callable[[bytes], int], Callable[[], None]]]:
    reader, writer = os.pipe()
    try:
        yield StandardInputReceiver(reader), lambda data: os.write(writer, data), lambda: os.close(writer)
    finally:
        os.close(reader)


def test_standard_input_takes_lines_and_ends_with_its_end() -> None:
    with piped() as (receiver, write, close):
        sink, stop = Kept(), threading.Event()
        write(line(1.0) + b"garbage\n" + line(1.01).strip())
        close()
        receiver.run(sink, stop)  # returns, though nobody stopped it
        assert sink.stamps() == [1.0, 1.01] and sink.causes == {"syntax": 1}


def test_standard_input_stops_though_nothing_comes() -> None:
    with piped() as (receiver, write, close), running(receiver) as sink:
        write(line(1.0))
        sink.until(lambda: sink.stamps() == [1.0])
        close()


def test_standard_input_plays_a_file_at_its_own_speed() -> None:
    with piped() as (receiver, write, close), running(receiver) as sink:
        write(b"".join(line(i / 100) for i in range(100)))
        close()
        sink.until(lambda: len(sink.packets) == 100)
        assert sink.arrivals[-1] - sink.arrivals[0] > 0.9


# WebSocket ----------------------------------------------------------------------------------------


@pytest.fixture
def web():
    """What makes a receiver, and what connects to one."""
    pytest.importorskip("websockets")
    from websockets.sync.client import connect as dial

    from cap4d.drive.websocket import WebSocketReceiver

    return WebSocketReceiver, dial


def test_websocket_takes_text_and_binary_messages_of_a_line_or_several(web) -> None:
    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink, dial(receiver.address) as sender:
        sender.send(line(1.0).decode())
        sender.send(line(1.1))
        sender.send(line(1.2) + line(1.21))
        sender.send("hello")
        sink.until(lambda: len(sink.packets) == 4 and sink.causes == {"syntax": 1})


def test_websocket_a_giant_message_ends_its_sender_and_nobody_else(web) -> None:
    from websockets.exceptions import ConnectionClosed

    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with dial(receiver.address) as sender, pytest.raises(ConnectionClosed):
            sender.send(b"x" * (MAX_LINE + 1))
            sender.recv(timeout=PATIENCE)
        sink.until(lambda: sink.causes == {"size": 1})
        with dial(receiver.address) as sender:
            sender.send(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])


def test_websocket_asks_for_the_token(web) -> None:
    from websockets.exceptions import InvalidStatus

    make, dial = web
    receiver = make("127.0.0.1", 0, token="a b&c")
    with running(receiver) as sink:
        for url, headers in (
            (receiver.address, {}),
            (receiver.address + "/?token=guess", {}),
            (receiver.address, {"Authorization": "Bearer guess"}),
        ):
            with pytest.raises(InvalidStatus, match="401"), dial(url, additional_headers=headers):
                pass
        assert sink.causes == {"token": 3}
        with dial(receiver.address + "/?token=a%20b%26c") as sender:
            sender.send(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])
        with dial(receiver.address, additional_headers={"Authorization": "Bearer a b&c"}) as sender:
            sender.send(line(2.0))
            sink.until(lambda: sink.stamps() == [1.0, 2.0])


def test_websocket_pages_of_other_hosts_are_refused(web) -> None:
    from websockets.exceptions import InvalidStatus

    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        for origin in ("https://evil.example", "null", "http://localhost.evil.example"):
            with pytest.raises(InvalidStatus, match="403"), dial(receiver.address, origin=origin):
                pass
        with dial(receiver.address, origin="http://localhost:8000") as sender:
            sender.send(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])
        assert sink.causes == {"token": 3}


def test_websocket_one_sender_rules(web) -> None:
    from websockets.exceptions import ConnectionClosed

    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with dial(receiver.address) as first, dial(receiver.address) as second:
            first.send(line(1.0))
            sink.until(lambda: len(sink.packets) == 1)
            second.send(line(9.0))
            with pytest.raises(ConnectionClosed, match="another one sends"):
                second.recv(timeout=PATIENCE)
            first.send(line(1.1))
            sink.until(lambda: len(sink.packets) == 2)
        with dial(receiver.address) as third:
            third.send(line(1.2))
            sink.until(lambda: sink.stamps() == [1.0, 1.1, 1.2])
        assert sink.causes == {"sender": 1}


def test_websocket_what_is_no_websocket_is_hung_up_on(web) -> None:
    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        for said in (b"GET / HTTP/1.1\r\n\r\n", b"\x00" * 1000, b"A" * 100_000):
            with connect(receiver) as sock:
                sock.sendall(said)
                closed(sock)
        with dial(receiver.address) as sender:
            sender.send(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])


def test_websocket_connections_that_say_nothing_are_hung_up_on(web, monkeypatch) -> None:
    from websockets.exceptions import ConnectionClosed

    make, dial = web
    monkeypatch.setattr("cap4d.drive.websocket.GREETING", 0.2)
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with dial(receiver.address) as sender, pytest.raises(ConnectionClosed, match="silent"):
            sender.recv(timeout=PATIENCE)
        with connect(receiver) as half_open:
            half_open.sendall(b"GET / HTT")
            closed(half_open)
        assert sink.causes == {"sender": 1}


def test_websocket_messages_without_a_line_are_silence(web, monkeypatch) -> None:
    from websockets.exceptions import ConnectionClosed

    make, dial = web
    monkeypatch.setattr("cap4d.drive.websocket.GREETING", 0.3)
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with dial(receiver.address) as sender, pytest.raises(ConnectionClosed, match="silent"):
            end = time.monotonic() + PATIENCE
            while time.monotonic() < end:
                sender.send(b"\n" * 1000)
                time.sleep(0.02)
        assert sink.causes == {"sender": 1}


def test_websocket_half_open_connections_are_limited(web) -> None:
    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        crowd = [connect(receiver) for _ in range(40)]
        sink.until(lambda: sink.causes == {"sender": 8})
        assert sum(closed_already(sock) for sock in crowd) == 8
        for sock in crowd:
            sock.close()
        sink.until(lambda: can_drive(dial, receiver.address))


def closed_already(sock: socket.socket) -> bool:
    sock.settimeout(0.02)
    try:
        return not sock.recv(1)
    except TimeoutError:
        return False
    except ConnectionResetError:
        return True


def can_drive(dial, address: str) -> bool:
    """Whether a WebSocket opens there."""
    from websockets.exceptions import WebSocketException

    try:
        with dial(address):
            return True
    except (OSError, EOFError, WebSocketException):
        return False


# started again --------------------------------------------------------------------------------------


def test_tcp_can_be_run_again() -> None:
    receiver = TcpReceiver("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink:
        sink.until(lambda: can_connect(receiver))
        with connect(receiver) as sender:
            sender.sendall(line(1.0))
            sink.until(lambda: sink.stamps() == [1.0])


def test_udp_can_be_run_again() -> None:
    receiver = UdpReceiver("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink, datagrams(receiver) as send:
        until_heard(sink, lambda: send(line(1.0)), lambda: sink.packets)


def test_live_link_can_be_run_again() -> None:
    receiver = LiveLinkReceiver("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink, datagrams(receiver) as send:
        until_heard(sink, lambda: send(b"garbage"), lambda: sink.causes["syntax"])


def test_websocket_can_be_run_again(web) -> None:
    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink:
        sink.until(lambda: can_drive(dial, receiver.address))


def until_heard(sink: Kept, send: Callable[[], None], heard: Callable[[], object]) -> None:
    """Sends until it is: what comes before the socket is open again is lost."""

    def is_heard() -> bool:
        send()
        return bool(heard())

    sink.until(is_heard)


def can_connect(receiver: Receiver) -> bool:
    try:
        connect(receiver).close()
    except ConnectionRefusedError:
        return False
    return True
