"""Where `cap4d drive` sends to. What the other side does (hangs up, never answers) never raises."""

from __future__ import annotations

import math
import os
import socket
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import BinaryIO, Protocol
from urllib.parse import SplitResult, parse_qs, urlencode, urlsplit

from cap4d.drive.wire import format_token
from cap4d.errors import ArgumentError, Cap4dError

FIRST_WAIT, LONGEST_WAIT = 0.1, 2.0  # s between attempts to connect; doubled from one to the next
PATIENCE = 1.0  # s that a connection or a write may take
MAX_DATAGRAM = 65507  # bytes: what a UDP datagram over IPv4 holds
MAX_ANSWER = 1 << 16  # bytes; a viewer has nothing to say

TARGETS = "tcp://HOST:PORT, udp://HOST:PORT, ws://HOST:PORT, livelink://HOST:PORT or -"


class Connection(Protocol):
    """Somebody who listens, for now."""

    def send(self, message: bytes) -> None:
        """Raises OSError when nobody does any more."""

    def close(self) -> None: ...


class Target:
    """A viewer that may come and go: connects again, after longer and longer waits.

    Args:
        address: What to call it.
        connect: Makes a connection, or raises OSError.
        largest: Bytes that a message may have.
    """

    def __init__(self, address: str, connect: Callable[[], Connection], *, largest: float = math.inf) -> None:
        self.address, self.largest = address, largest
        self.reason = "not tried yet"  # why there is no connection
        self.connections = 0  # made so far
        self._connect = connect
        self._connection: Connection | None = None
        self._wait, self._next = FIRST_WAIT, -math.inf

    def connected(self, now: float) -> bool:
        """Whether there is a connection at `now` s; tries to make one when it is time to."""
        if self._connection is None and now >= self._next:
            try:
                self._connection = self._connect()
                self._wait, self.connections = FIRST_WAIT, self.connections + 1
            except OSError as error:
                self._fail(error, now)
        return self._connection is not None

    def send(self, message: bytes, now: float) -> bool:
        """Whether the message went out."""
        if not self.connected(now):
            return False
        try:
            self._connection.send(message)
        except OSError as error:
            self._connection.close()
            self._connection = None
            self._fail(error, now)
            return False
        return True

    def close(self) -> None:
        """Hangs up."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _fail(self, error: OSError, now: float) -> None:
        self.reason = error.strerror or str(error) or type(error).__name__
        self._next = now + self._wait
        self._wait = min(2 * self._wait, LONGEST_WAIT)


class TcpConnection:
    """One stream of bytes."""

    def __init__(self, host: str, port: int, token: str | None) -> None:
        self._socket = socket.create_connection((host, port), timeout=PATIENCE)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if token is not None:
            self.send(format_token(token))

    def send(self, message: bytes) -> None:
        """See `Connection`."""
        if self._hung_up():
            raise ConnectionResetError("the viewer hung up")
        self._socket.sendall(message)

    def close(self) -> None:
        """See `Connection`."""
        self._socket.close()

    def _hung_up(self) -> bool:
        """Without this the first frames after a hang-up would be written to nobody."""
        self._socket.setblocking(False)
        try:
            return not self._socket.recv(MAX_ANSWER)
        except BlockingIOError:
            return False
        finally:
            self._socket.settimeout(PATIENCE)


class UdpConnection:
    """Datagrams to one address; that nobody listens shows, where it does, one datagram late."""

    def __init__(self, host: str, port: int) -> None:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.connect(address)
        except OSError:
            self._socket.close()
            raise

    def send(self, message: bytes) -> None:
        """See `Connection`."""
        self._socket.send(message)

    def close(self) -> None:
        """See `Connection`."""
        self._socket.close()


class WebSocketConnection:
    """One message a frame. Needs the package `websockets`."""

    def __init__(self, url: str) -> None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        self._broken, self._open = WebSocketException, ExitStack()
        limits = {"open_timeout": PATIENCE, "close_timeout": PATIENCE, "max_size": MAX_ANSWER}
        try:
            self._socket = self._open.enter_context(connect(url, compression=None, proxy=None, **limits))
        except WebSocketException as error:
            raise ConnectionError(str(error)) from error

    def send(self, message: bytes) -> None:
        """See `Connection`. Text where it is text; garbage goes as it is."""
        try:
            said: str | bytes = message.decode()
        except UnicodeDecodeError:
            said = message
        try:
            self._socket.send(said)
        except self._broken as error:
            raise ConnectionResetError(str(error)) from error

    def close(self) -> None:
        """See `Connection`."""
        self._open.close()


class StreamConnection:
    """Lines into a pipe."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def send(self, message: bytes) -> None:
        """See `Connection`."""
        try:
            self._stream.write(message)
            self._stream.flush()
        except BrokenPipeError as error:
            os.dup2(
                os.open(os.devnull, os.O_WRONLY), self._stream.fileno()
            )  # or closing it would raise again
            raise Cap4dError("standard output: nobody reads it any more") from error

    def close(self) -> None:
        """See `Connection`: it is not ours to close."""


def open_target(url: str, *, token: str | None = None) -> Target:
    """The target that `--to` names; nothing is connected yet.

    Args:
        token: What it asks for; one in the URL (`?token=X`) goes before it.
    Raises:
        ArgumentError: No such kind of target, or no port in it.
    """
    if url == "-":
        stream = StreamConnection(sys.stdout.buffer)
        return Target("-", lambda: stream)
    parts, port = _split(url)
    host, address = parts.hostname, f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}"
    token = parse_qs(parts.query).get("token", [token])[-1]
    if parts.scheme == "tcp":
        return Target(address, lambda: TcpConnection(host, port, token))
    if parts.scheme == "ws":
        import websockets  # noqa: F401  # its absence shows here, not at the first attempt to connect

        query = "" if token is None else "?" + urlencode({"token": token})
        return Target(address, lambda: WebSocketConnection(f"{address}{parts.path or '/'}{query}"))
    return Target(address, lambda: UdpConnection(host, port), largest=MAX_DATAGRAM)


def token_of(url: str, token: str | None) -> str | None:
    """The token that every datagram to `url` carries; other targets get theirs when they are connected."""
    if not url.startswith("udp://"):
        return None
    return parse_qs(urlsplit(url).query).get("token", [token])[-1]


def _split(url: str) -> tuple[SplitResult, int]:
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme not in ("tcp", "udp", "ws", "livelink") or not parts.hostname or not port:
        raise ArgumentError(f"to: expected {TARGETS}, got {url}")
    return parts, port
