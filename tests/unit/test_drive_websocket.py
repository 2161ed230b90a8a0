"""Lines over WebSockets on loopback: who may send, what is counted, what ends and what does not."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import pytest
from receiving import PATIENCE, closed, connect, line, running

from cap4d.drive.listener import MAX_CONNECTIONS
from cap4d.drive.packet import Receiver
from cap4d.drive.wire import MAX_LINE

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection


@pytest.fixture
def web():
    """What makes a receiver, and what connects to one."""
    pytest.importorskip("websockets")
    from websockets.sync.client import connect as dial

    from cap4d.drive.websocket import WebSocketReceiver

    return WebSocketReceiver, dial


@contextmanager
def hung_up_on(dial, receiver: Receiver, why: str | None = None) -> Iterator[ClientConnection]:
    """A connection that the receiver ends, for that reason, before the body does."""
    from websockets.exceptions import ConnectionClosed

    with dial(receiver.address) as sender, pytest.raises(ConnectionClosed, match=why):
        yield sender


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
    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with hung_up_on(dial, receiver) as sender:
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
    make, dial = web
    monkeypatch.setattr("cap4d.drive.websocket.GREETING", 0.2)
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with hung_up_on(dial, receiver, "silent") as sender:
            sender.recv(timeout=PATIENCE)
        with connect(receiver) as half_open:
            half_open.sendall(b"GET / HTT")
            closed(half_open)
        assert sink.causes == {"sender": 1}


def test_websocket_messages_without_a_line_are_silence(web, monkeypatch) -> None:
    make, dial = web
    monkeypatch.setattr("cap4d.drive.websocket.GREETING", 0.3)
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink:
        with hung_up_on(dial, receiver, "silent") as sender:
            end = time.monotonic() + PATIENCE
            while time.monotonic() < end:
                sender.send(b"\n" * 1000)
                time.sleep(0.02)
        assert sink.causes == {"sender": 1}


def test_websocket_connections_are_limited(web, monkeypatch) -> None:
    from websockets.exceptions import InvalidStatus

    make, dial = web
    monkeypatch.setattr("cap4d.drive.websocket.GREETING", 10 * PATIENCE)  # after it all are hung up on
    receiver = make("127.0.0.1", 0)
    with running(receiver) as sink, ExitStack() as crowd:
        for _ in range(MAX_CONNECTIONS):
            crowd.enter_context(dial(receiver.address))
        with pytest.raises(InvalidStatus, match="503"), dial(receiver.address):
            pass
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


def test_websocket_can_be_run_again(web) -> None:
    make, dial = web
    receiver = make("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink:
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
