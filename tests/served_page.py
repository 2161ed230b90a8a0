"""A page that is served over loopback, and what its script does, without a browser."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from cap4d.app.playback import ClipPlayback
from cap4d.app.serve.door import Door
from cap4d.app.serve.performance import Performance
from cap4d.app.serve.server import PageServer
from cap4d.app.serve.studio import Studio
from tiny_bundle import tiny_bundle
from websockets.sync.client import connect

from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import camera_path

PATIENCE = 20.0  # s that anything may take on a busy machine


def tiny_studio(*, clock: Callable[[], float] = time.monotonic, **settings) -> Studio:
    """Not started."""
    bundle = tiny_bundle(network=False)
    performance = Performance(ClipPlayback(bundle.idle, clock()), bundle)
    cameras = camera_path("static", bundle.camera, np.zeros(3), fps=24, size=None)
    avatar = Avatar(bundle, deformer="off", threads=1)
    return Studio(avatar, performance, cameras, backend="cpu", area=128 * 128, clock=clock, **settings)


class Served:
    """A page that is being served.

    Attributes:
        port: Where; `studio`, `server`: what.
    """

    def __init__(self, door: Door, *, limit: int = 4) -> None:
        self.studio = tiny_studio(limit=limit)
        self.door, self.server = door, PageServer(self.studio, door, title="tiny")
        self.port = 0

    def url(self, path: str = "/socket", token: str | None = None) -> str:
        """Of the WebSocket."""
        query = "" if token is None else f"?token={token}"
        return f"ws://127.0.0.1:{self.port}{path}{query}"

    def get(self, path: str, *, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """(status, headers, body) of a request."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        found = answer.status, dict(answer.getheaders()), answer.read()
        connection.close()
        return found


@contextlib.contextmanager
def serving(door: Door | None = None, **options) -> Iterator[Served]:
    """Serves on a free port until the block ends."""
    served = Served(Door("127.0.0.1") if door is None else door, **options)
    served.studio.start()
    listens, loops = threading.Event(), []
    over = asyncio.Event()

    async def run() -> None:
        loops.append(asyncio.get_running_loop())

        def ready(port: int) -> None:
            served.port = port
            listens.set()

        await served.server.run(0, ready=ready, over=over)

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    try:
        assert listens.wait(PATIENCE)
        yield served
    finally:
        loops[0].call_soon_threadsafe(over.set)
        thread.join(PATIENCE)
        served.studio.stop()
        assert not thread.is_alive()


def head_of(data: bytes) -> dict:
    """Of a picture's message."""
    (length,) = struct.unpack_from("<I", data)
    return json.loads(data[4 : 4 + length])


class Client:
    """What the page's script does, without a page."""

    def __init__(self, line) -> None:
        self.line = line
        self.told = [json.loads(line.recv(timeout=PATIENCE)) for _ in range(2)]

    def say(self, **words) -> None:
        self.line.send(json.dumps(words))

    def picture(self, *, echo: bool = True) -> tuple[dict, bytes]:
        """The next picture's head and JPEG, or fails; other messages are put into `told`."""
        while True:
            data = self.line.recv(timeout=PATIENCE)
            if isinstance(data, bytes):
                break
            self.told.append(json.loads(data))
        head = head_of(data)
        if echo:
            self.say(ack=head["n"])
        return head, data[data.index(b"\xff\xd8") :]

    def until(self, seen: Callable[[dict], bool]) -> None:
        """Takes pictures until the state told last is the one looked for, or fails."""
        end = time.monotonic() + PATIENCE
        while not seen(self.told[-1].get("state", {})):
            assert time.monotonic() < end, self.told[-1]
            self.picture()

    def silent(self, seconds: float) -> bool:
        """Whether nothing comes for that long."""
        try:
            self.line.recv(timeout=seconds)
        except TimeoutError:
            return True
        return False


@contextlib.contextmanager
def watching(served: Served, **options) -> Iterator[Client]:
    with connect(served.url(), compression=None, proxy=None, **options) as line:
        yield Client(line)


def decoded(jpeg: bytes) -> np.ndarray:
    image_module = pytest.importorskip("PIL.Image")
    return np.asarray(image_module.open(io.BytesIO(jpeg)).convert("RGB"))


@contextlib.contextmanager
def command(*words: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """cap4d-view --serve in a process of its own, and the address that it prints."""
    line = [sys.executable, "-m", "cap4d.app.main", "tiny.cap4d", "--deformer", "off", *words]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        try:
            told = []
            for line in process.stderr:
                if line.startswith("http"):
                    break
                told.append(line.strip())
            process.told = "\n".join(told)
            yield process, line.strip()
        finally:
            process.kill()
