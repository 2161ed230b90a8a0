"""Frames over WebSocket: the player is the server, a sender's message is a line of JSON (`wire`), or several.

A web page may drive the player of the computer it is looked at on only with the token, or when it comes
from that computer itself: browsers name the page in `Origin`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from cap4d.drive.gate import Gate
from cap4d.drive.listener import MAX_CONNECTIONS, Listener
from cap4d.drive.pace import Pace, unread
from cap4d.drive.packet import Cause, Sink
from cap4d.drive.tcp import FLOODED, GREETING, IDLE
from cap4d.drive.wire import MAX_LINE, lines_of, same_token

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

POLL = 0.1  # s
MAX_OPEN = 32  # connections on the port, half-open ones counted
LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
TRY_AGAIN_LATER, POLICY = 1013, 1008  # close codes, RFC 6455 7.4.1 and IANA's registry


class WebSocketReceiver:
    """A WebSocket server; see `packet.Receiver`.

    Args:
        host, port: See `Listener`.
        token: Asked for in the URL, `?token=...`, or as `Authorization: Bearer ...`; None for none.
    Raises:
        ArgumentError: There is no listening there.
        ModuleNotFoundError: The package websockets is not installed.
    """

    def __init__(
        self, host: str, port: int, *, token: str | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        import websockets  # noqa: F401  its absence is told before anything starts

        self.token, self._clock = token, clock
        self._listener = Listener("ws", host, port, socket.SOCK_STREAM)
        self.address = self._listener.address

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `packet.Receiver`."""
        with self._listener as listener:
            asyncio.run(self._serve(listener, sink, stop))

    async def _serve(self, listener: socket.socket, sink: Sink, stop: threading.Event) -> None:
        from websockets.asyncio.server import serve

        visitors = _Visitors(sink, self.token, self._clock)
        async with serve(
            visitors.drive,
            sock=listener,
            process_request=visitors.admit,
            create_connection=_counted(visitors),
            compression=None,
            max_size=MAX_LINE,
            max_queue=16,
            open_timeout=GREETING,
            ping_interval=IDLE / 4,
            ping_timeout=IDLE / 4,
            close_timeout=POLL,
            server_header=None,
            logger=_quiet(),
        ):
            while not stop.is_set():
                await asyncio.sleep(POLL)


class _Visitors:
    """The connections of one server, in its event loop."""

    def __init__(self, sink: Sink, token: str | None, clock: Callable[[], float]) -> None:
        self.sink, self.token, self.clock = sink, token, clock
        self.gate, self.count = Gate(sink), 0
        self.open = 0  # connections, those included that have not said yet what they want

    def admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuses who lacks the token, comes from a foreign page, or is one too many."""
        if not same_token(_token(request), self.token):
            self.sink.rejected(Cause.TOKEN, "a connection without the token")
            return connection.respond(HTTPStatus.UNAUTHORIZED, "expected ?token=...\n")
        origin = request.headers.get("Origin")
        if self.token is None and origin is not None and urlsplit(origin).hostname not in LOCAL:
            self.sink.rejected(Cause.TOKEN, f"a web page of {origin[:100]} without a token")
            return connection.respond(HTTPStatus.FORBIDDEN, "a page of another host needs ?token=...\n")
        if self.count >= MAX_CONNECTIONS:
            self.sink.rejected(Cause.SENDER, f"{MAX_CONNECTIONS} are connected already")
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections\n")
        return None

    async def drive(self, connection: ServerConnection) -> None:
        """One connection, until it ends."""
        from websockets.exceptions import ConnectionClosed, PayloadTooBig

        self.count += 1
        try:
            with contextlib.suppress(ConnectionClosed):
                await self._listen_to(connection)
            if isinstance(connection.protocol.parser_exc, PayloadTooBig):
                self.sink.rejected(Cause.SIZE, "a message is longer than any frame")
        finally:
            self.count -= 1
            self.gate.leave(connection)

    async def _listen_to(self, connection: ServerConnection) -> None:
        pace, due = Pace(), self.clock() + GREETING
        while True:
            try:
                message = await asyncio.wait_for(connection.recv(decode=False), due - self.clock())
            except TimeoutError:
                self.sink.rejected(Cause.SENDER, "a connection is silent")
                return await connection.close(POLICY, "silent")
            lines = deque(lines_of(message))
            if not lines:  # as good as silence, and no faster
                await asyncio.sleep(POLL)
                continue
            due = self.clock() + IDLE
            if not self.gate.rules(connection, self.clock()):
                await asyncio.sleep(POLL)  # for one who rules to have hung up just now
            while lines:
                now = self.clock()
                line = lines.popleft()
                t = self.gate.line(connection, line, now)
                if not self.gate.rules(connection, now):
                    return await connection.close(TRY_AGAIN_LATER, "another one sends already")
                if self.gate.flooded:
                    self.sink.rejected(Cause.FLOOD, times=len(lines))
                    lines.clear()
                    await asyncio.sleep(FLOODED)
                elif t is not None:
                    waiting = unread(connection.transport.get_extra_info("socket").fileno())
                    await asyncio.sleep(pace.lead(t, now, size=len(line), waiting=waiting))


def _counted(visitors: _Visitors) -> type[ServerConnection]:
    """Connections that are counted, and cut where there are too many."""
    from websockets.asyncio.server import ServerConnection

    class Counted(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            visitors.open += 1
            super().connection_made(transport)
            if visitors.open > MAX_OPEN:
                visitors.sink.rejected(Cause.SENDER, f"{MAX_OPEN} connections are open already")
                transport.abort()

        def connection_lost(self, error: Exception | None) -> None:
            visitors.open -= 1
            super().connection_lost(error)

    return Counted


def _token(request: Request) -> str | None:
    given = parse_qs(urlsplit(request.path).query).get("token")
    kind, _, value = request.headers.get("Authorization", "").partition(" ")
    return given[0] if given else value if kind.lower() == "bearer" else None


def _quiet() -> logging.Logger:
    """Strangers who break the protocol are counted, not told of."""
    logger = logging.getLogger(__name__ + ".connections")
    logger.setLevel(logging.CRITICAL)
    return logger
