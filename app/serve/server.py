"""The page and its WebSocket on one port, through the `websockets` package."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable
from importlib.resources import files

from cap4d.app.serve.door import NOT_ALLOWED, OPEN_PATHS, PAGE, SOCKET, Door, Refusal
from cap4d.app.serve.message import MAX_MESSAGE, BadMessageError, parse_message
from cap4d.app.serve.studio import Studio
from cap4d.app.serve.watcher import Watcher

log = logging.getLogger(__name__)

OPENING_SECONDS = 5.0  # that a browser has to say what it wants
CLOSING_SECONDS = 1.0  # for goodbyes
SENDING_SECONDS = 10.0  # that a message may take to leave
PING_SECONDS = 10.0  # between pings, and for their answers
MAX_CONNECTIONS = 64  # on the port, half-open ones counted
MAX_WAITING = 64  # messages that have not left for one browser; two of them are pictures, the rest is small
MESSAGES_PER_SECOND = 400  # of one page; it sends a few per picture
FULL = "{} people are watching already. Try again when one has left."
POLICY, TRY_AGAIN = 1008, 1013  # WebSocket close codes

TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "X-Content-Type-Options": "nosniff",
}


class PageServer:
    """Serves one studio.

    Args:
        studio: Already started.
        door: Who may look.
        title: Of the page.
    """

    def __init__(self, studio: Studio, door: Door, *, title: str) -> None:
        self.studio, self.door, self.title = studio, door, title
        self._sockets: dict[Watcher, object] = {}
        self._connections = 0
        self._files = read_files()

    async def run(self, port: int, *, ready: Callable[[int], None], over: asyncio.Event) -> None:
        """Serves until `over` is set or the task is cancelled, then says goodbye to everybody.

        Args:
            port: 0 is any free one.
            ready: Told the port that it became.
        Raises:
            OSError: It cannot listen there.
        """
        from websockets.asyncio.server import serve

        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # what strangers do is not our user's news
        async with serve(
            self._watch,
            self.door.host,
            port,
            process_request=self._answer,
            create_connection=self._connection_class(),
            max_size=MAX_MESSAGE,
            compression=None,  # pictures are compressed already
            server_header=None,
            open_timeout=OPENING_SECONDS,
            ping_interval=PING_SECONDS,
            ping_timeout=PING_SECONDS,
            close_timeout=CLOSING_SECONDS,
        ) as server:
            ready(server.sockets[0].getsockname()[1])
            await self._keep_watch(over)

    # HTTP -----------------------------------------------------------------------------------------

    def _answer(self, connection, request):
        """The file that is asked for; None lets the WebSocket open."""
        refusal = self.door.refusal(request.path, SingleHeaders(request.headers))
        path = request.path.partition("?")[0]
        if getattr(request, "method", "GET") != "GET":  # older versions refuse others by themselves
            refusal = NOT_ALLOWED
        if refusal is None and path in (PAGE, SOCKET) and self.studio.is_full:
            refusal = Refusal(503, FULL.format(self.studio.limit))
        if refusal is not None:
            return self._respond(refusal.status, "text/html", self._refusal_page(refusal))
        if path == SOCKET:
            return None
        kind, body = self._files[path]
        return self._respond(200, kind, body)

    def _respond(self, status: int, kind: str, body: bytes):
        from http import HTTPStatus

        from websockets.datastructures import Headers
        from websockets.http11 import Response

        headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))}
        headers |= {"Connection": "close"} | HEADERS
        return Response(status, HTTPStatus(status).phrase, Headers(headers), body)

    def _refusal_page(self, refusal: Refusal) -> bytes:
        _, body = self._files["refused"]
        return body.replace(b"{{text}}", refusal.text.encode())

    def _connection_class(self):
        """Connections that are counted, and cut where there are too many."""
        from websockets.asyncio.server import ServerConnection

        server = self

        class Counted(ServerConnection):
            def connection_made(self, transport) -> None:
                server._connections += 1
                super().connection_made(transport)
                if server._connections > MAX_CONNECTIONS:
                    transport.abort()

            def connection_lost(self, error) -> None:
                server._connections -= 1
                super().connection_lost(error)

        return Counted

    # WebSocket ------------------------------------------------------------------------------------

    async def _watch(self, socket) -> None:
        """One browser, from its coming to its going."""
        from websockets.exceptions import ConnectionClosed

        messages: asyncio.Queue[bytes | str] = asyncio.Queue(MAX_WAITING)
        loop = asyncio.get_running_loop()

        def put(data: bytes | str) -> None:
            try:
                messages.put_nowait(data)
            except asyncio.QueueFull:  # it does not take what it is sent
                socket.transport.abort()

        def deliver(data: bytes) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has just ended
                loop.call_soon_threadsafe(put, data)

        watcher = self.studio.admit(deliver)
        if watcher is None:
            await socket.close(TRY_AGAIN, "full")
            return
        self._sockets[watcher] = socket
        put(json.dumps({"hello": self.studio.introduction() | {"title": self.title}}))
        put(json.dumps({"state": self.studio.state()}))
        sender = asyncio.create_task(self._send(socket, messages))
        try:
            await self._hear(socket, watcher, messages)
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            del self._sockets[watcher]
            self.studio.dismiss(watcher)

    async def _hear(self, socket, watcher: Watcher, messages: asyncio.Queue) -> None:
        meter = Meter(MESSAGES_PER_SECOND)
        async for data in socket:
            try:
                if not meter.allows(time.monotonic()):
                    raise BadMessageError("expected fewer messages")
                message = parse_message(data)
            except BadMessageError as error:
                await socket.close(POLICY, str(error))
                return
            if self.studio.hear(watcher, message):
                self._tell_everybody()

    async def _send(self, socket, messages: asyncio.Queue) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                data = await messages.get()
                async with asyncio.timeout(SENDING_SECONDS):
                    await socket.send(data)
        except (TimeoutError, ConnectionClosed):
            socket.transport.abort()

    def _tell_everybody(self) -> None:
        state = json.dumps({"state": self.studio.state()})
        for watcher in self._sockets:
            watcher.deliver(state)

    async def _keep_watch(self, over: asyncio.Event) -> None:
        """Drops those who do not show what they are sent."""
        while not over.is_set() and self.studio.failure is None:
            for watcher in self.studio.stalled():
                if watcher in self._sockets:
                    self._sockets[watcher].transport.abort()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(over.wait(), 0.5)


class Meter:
    """Counts by the second."""

    def __init__(self, limit: int) -> None:
        self.limit, self._second, self._count = limit, -1, 0

    def allows(self, now: float) -> bool:
        """One more at `now` s."""
        if int(now) != self._second:
            self._second, self._count = int(now), 0
        self._count += 1
        return self._count <= self.limit


class SingleHeaders(dict):
    """Headers by name in any case; what is there twice is not believed at all."""

    def __init__(self, headers) -> None:
        super().__init__()
        for name, value in headers.raw_items():
            name = name.title()
            self[name] = value if name not in self else ""


def read_files() -> dict[str, tuple[str, bytes]]:
    """All that is ever served: path -> (type, content)."""
    folder = files("cap4d.app.serve")
    names = {PAGE: "page.html", "refused": "refused.html"} | {path: path[1:] for path in OPEN_PATHS}
    kinds = {path: TYPES[name.rpartition(".")[2]] for path, name in names.items()}
    return {path: (kinds[path], folder.joinpath(name).read_bytes()) for path, name in names.items()}
