"""Frames over TCP: the player listens, a sender connects and writes a line of JSON a frame (`wire`)."""

from __future__ import annotations

import contextlib
import json
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable

from cap4d.drive.gate import Gate
from cap4d.drive.listener import MAX_CONNECTIONS, Listener
from cap4d.drive.pace import Pace, unread
from cap4d.drive.packet import Cause, Rejected, Sink
from cap4d.drive.wire import LineSplitter, check_token, parse_object

READ = 1 << 16  # bytes at once
GREETING = 5.0  # s in which a connection has to bring its first frame
IDLE = 60.0  # s without a line, after which a connection is taken for dead
POLL = 0.1  # s
FLOODED = 20e-3  # s that a connection is not read after a flood, of which all that was read is dropped


class TcpReceiver:
    """A listening socket; see `packet.Receiver`.

    Args:
        host, port: See `Listener`.
        token: What the first line, `{"token": "..."}`, has to say; None for no such line.
    Raises:
        ArgumentError: There is no listening there.
    """

    def __init__(
        self, host: str, port: int, *, token: str | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.token, self._clock = token, clock
        self._listener = Listener("tcp", host, port, socket.SOCK_STREAM)
        self.address = self._listener.address

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `packet.Receiver`."""
        with self._listener as listener, selectors.DefaultSelector() as selector:
            selector.register(listener, selectors.EVENT_READ)
            server = _Server(sink, selector, listener, self.token)
            try:
                while not stop.is_set():
                    server.turn(self._clock)
            finally:
                server.close()


class _Connection:
    """One sender's socket, and the lines of it that are still to be looked at."""

    def __init__(self, sock: socket.socket, now: float, *, trusted: bool) -> None:
        self.sock, self.trusted = sock, trusted
        self.splitter, self.pace = LineSplitter(), Pace()
        self.lines: deque[bytes | None] = deque()
        self.greeted = self.ended = self.is_read = False
        self.heard = self.until = now  # the last line; not attended to before

    def read(self) -> None:
        """Takes in what has come."""
        try:
            data = self.sock.recv(READ)
        except (BlockingIOError, InterruptedError):
            return
        self.ended = not data
        self.lines.extend(self.splitter.feed(data or b"\n"))

    def waiting(self) -> int:
        """Bytes that nobody has looked at."""
        return sum(len(line or b"") for line in self.lines) + unread(self.sock.fileno())

    def is_dead(self, now: float) -> bool:
        """Whether it has been silent for longer than a sender is."""
        return now - self.heard > (IDLE if self.greeted else GREETING)


class _Server:
    """The connections of one listening socket."""

    def __init__(
        self, sink: Sink, selector: selectors.BaseSelector, listener: socket.socket, token: str | None
    ) -> None:
        self.sink, self.selector, self.listener, self.token = sink, selector, listener, token
        self.gate, self.connections = Gate(sink), []

    def turn(self, clock: Callable[[], float]) -> None:
        """Waits for something to do, a tenth of a second at most, and does it."""
        now = clock()
        for connection in self.connections:
            self._watch(connection, not connection.lines and connection.until <= now)
        due = min((c.until for c in self.connections if c.until > now), default=now + POLL)
        ready = {key.fileobj for key, _ in self.selector.select(min(due - now, POLL))}
        now = clock()
        if self.listener in ready:
            self._accept(now)
        for connection in list(self.connections):
            self._attend(connection, connection.sock in ready, now)

    def close(self) -> None:
        """Hangs up on everybody."""
        for connection in list(self.connections):
            self._hang_up(connection)

    def _watch(self, connection: _Connection, is_read: bool) -> None:
        if is_read and not connection.is_read:
            self.selector.register(connection.sock, selectors.EVENT_READ)
        elif connection.is_read and not is_read:
            self.selector.unregister(connection.sock)
        connection.is_read = is_read

    def _accept(self, now: float) -> None:
        try:
            sock, _ = self.listener.accept()
        except OSError:  # it is gone again, or there are no more files to be had
            return
        sock.setblocking(False)
        if len(self.connections) < MAX_CONNECTIONS:
            self.connections.append(_Connection(sock, now, trusted=self.token is None))
        else:
            self.sink.rejected(Cause.SENDER, f"{MAX_CONNECTIONS} are connected already")
            sock.close()

    def _attend(self, connection: _Connection, is_ready: bool, now: float) -> None:
        try:
            if is_ready:
                connection.read()
            self._listen_to(connection, now)
            if connection.is_dead(now):
                raise Rejected(Cause.SENDER, "a connection is silent")
        except Rejected as error:
            self.sink.rejected(error.cause, error.detail)
            self._say(connection, error)
            self._hang_up(connection)
        except OSError:  # reset by the other side
            self._hang_up(connection)
        else:
            if connection.ended and not connection.lines:
                self._hang_up(connection)

    def _listen_to(self, connection: _Connection, now: float) -> None:
        """Looks at the lines that are there, up to one that is ahead of its time."""
        while connection.lines and connection.until <= now:
            line = connection.lines.popleft()
            connection.greeted, connection.heard = True, now
            if not connection.trusted:
                check_token(parse_object(line or b"{}"), self.token)
                connection.trusted = True
            elif not self.gate.rules(connection, now):
                raise Rejected(Cause.SENDER, "another one sends already")
            elif (t := self.gate.line(connection, line, now)) is not None:
                connection.until = now + connection.pace.lead(
                    t, now, size=len(line), waiting=connection.waiting()
                )
            elif self.gate.flooded:
                self.sink.rejected(Cause.FLOOD, times=len(connection.lines))
                connection.lines.clear()
                connection.until = now + FLOODED

    def _say(self, connection: _Connection, error: Rejected) -> None:
        """Tells the other side why, if it listens."""
        with contextlib.suppress(OSError):
            connection.sock.send(json.dumps({"error": str(error)}).encode() + b"\n")

    def _hang_up(self, connection: _Connection) -> None:
        self._watch(connection, False)
        self.connections.remove(connection)
        self.gate.leave(connection)
        connection.sock.close()
