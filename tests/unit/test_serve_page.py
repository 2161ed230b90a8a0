"""The page over loopback: what is answered, what is refused; and in a real browser an avatar."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("onnx")

from cap4d.app.main import main
from cap4d.app.playback import ClipPlayback
from cap4d.app.serve import server as server_module
from cap4d.app.serve.door import Door
from cap4d.app.serve.jpeg import JpegEncoder
from cap4d.app.serve.message import Message, parse_message
from cap4d.app.serve.performance import Performance
from cap4d.app.serve.server import PageServer
from cap4d.app.serve.studio import Studio
from chromium import browser, chromium
from tiny_bundle import tiny_bundle
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from cap4d.bundle import write_bundle
from cap4d.drive.packet import Packet
from cap4d.drive.wire import format_packet
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


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serving() as found:
        yield found


# HTTP ----------------------------------------------------------------------------------------------


def test_the_page_and_its_files_are_served_with_headers_that_lock_it_down(served):
    for path, kind in (
        ("/", "html"),
        ("/page.css", "css"),
        ("/page.js", "javascript"),
        ("/favicon.svg", "svg"),
    ):
        status, headers, body = served.get(path)
        assert status == 200
        assert kind in headers["Content-Type"]
        assert len(body) == int(headers["Content-Length"]) > 200
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize(
    "path", ["/../door.py", "/page.html", "/server.py", "/etc/passwd", "/%2e%2e/door.py"]
)
def test_nothing_else_is_there(served, path):
    assert served.get(path)[0] == 404


def test_a_name_that_is_not_this_machines_is_refused(served):
    status, _, body = served.get("/", Host="evil.org")
    assert status == 403
    assert b"localhost only" in body


@pytest.mark.parametrize("method", ["POST", "PUT", "OPTIONS"])
def test_only_get_is_answered(served, method):
    assert served.get("/", method=method)[0] >= 400


def test_another_site_may_not_connect(served):
    with (
        pytest.raises(InvalidStatus, match="403"),
        connect(served.url(), origin="http://evil.org", proxy=None),
    ):
        pass
    with connect(served.url(), origin=f"http://127.0.0.1:{served.port}", proxy=None):
        pass


def test_where_others_can_reach_it_the_token_goes_before_everything():
    with serving(Door("0.0.0.0", "secret")) as served:
        assert served.get("/")[0] == served.get("/?token=wrong")[0] == 403
        assert b"token" in served.get("/")[2]
        for token in (None, "", "wrong"):
            with pytest.raises(InvalidStatus, match="403"), connect(served.url(token=token), proxy=None):
                pass
        assert served.get("/?token=secret", Host="any.name")[0] == 200
        with connect(served.url(token="secret"), proxy=None) as line:
            assert "hello" in Client(line).told[0]


# pictures ------------------------------------------------------------------------------------------


def test_pictures_come_in_order_move_and_are_no_larger_than_asked_for(served):
    with watching(served) as client:
        client.say(size=[640, 320], background=[1, 0, 0])
        pictures = [client.picture() for _ in range(20)]
    numbers = [head["n"] for head, _ in pictures]
    assert numbers == list(range(20))
    images = [decoded(jpeg) for head, jpeg in pictures if head["size"] == [180, 90]]
    assert len(images) > 10
    assert images[0].shape == (90, 180, 3)
    assert np.abs(images[-1][0, 0].astype(int) - [255, 0, 0]).max() < 12  # the page's colour
    assert np.abs(images[-1].astype(int) - images[-6]).max() > 20  # it moves
    assert np.abs(images[-1].astype(int) - [255, 0, 0]).max(-1).mean() > 20  # there is an avatar
    assert pictures[-1][0]["latency"] > 0


def test_no_more_than_two_pictures_come_unanswered(served):
    with watching(served) as client:
        client.picture(echo=False)
        second = client.picture(echo=False)[0]
        assert client.silent(0.3)
        client.say(ack=second["n"])
        assert client.picture()[0]["n"] == 2


def test_who_was_slow_is_sent_the_latest_moment_and_nothing_between():
    now = 100.0
    studio, sent = tiny_studio(clock=lambda: now), []
    watcher, painter, encoder = studio.admit(sent.append), CountingPainter(), JpegEncoder()
    for now in (100.0, 100.05, 100.1, 100.2):  # noqa: B007  the studio's clock
        studio._draw_next(painter, encoder)
    assert [head_of(data)["at"] for data in sent] == [0.0, 0.042]
    now = 100.3
    assert studio.performance.number(now) == (7, 0)
    studio.hear(watcher, parse_message('{"ack": 1}'))
    studio._draw_next(painter, encoder)
    assert head_of(sent[-1])["at"] == 0.292  # frame 7 at 24 a second
    assert head_of(sent[-1])["latency"] == pytest.approx(250.0)
    assert len(sent) == painter.poses == 3


def test_a_paused_picture_is_sent_once_a_drag_sends_another_and_home_the_first_again(served):
    with watching(served) as client:
        client.say(play=False, seek=0.1, size=[100, 100])
        while True:
            head, first = client.picture()
            if head["size"] == [100, 100] and client.silent(0.5):
                break
        client.say(turn=[0.2, 0.0])
        turned = client.picture()[1]
        assert client.silent(0.3)
        client.say(home=True)
        again = client.picture()[1]
        client.say(play=True)
        client.picture()
    assert np.abs(decoded(turned).astype(int) - decoded(first)).max() > 50
    assert again == first


def test_what_one_does_to_the_face_all_see(served):
    with watching(served) as one, watching(served) as other:
        one.say(expr={"jawOpen": 0.75, "no such": 1})
        for client in (one, other):
            while client.told[-1].get("state", {}).get("held") != {"jawOpen": 0.75}:
                client.picture()
        one.say(reset=True, expr={"jawOpen": None})
        while other.told[-1]["state"]["held"]:
            other.picture()


def test_a_live_head_is_turned_once_whoever_has_the_camera():
    studio = tiny_studio(turns_head=True)
    frame = studio._seen = replace(studio.performance.frame(), rot=np.float32([0, 0.5, 0]))
    watcher = studio.admit(lambda _: None)
    before = studio._camera(watcher.shot((0, 0), 0.0), frame, (0, 0))
    assert not np.allclose(before.viewmat, studio.avatar.camera.viewmat, atol=0.1)
    watcher.look(Message(zoom=0.0), studio._view)
    taken_over = studio._camera(watcher.shot((0, 0), 0.0), frame, (0, 0))
    assert np.allclose(taken_over.viewmat, before.viewmat, atol=1e-6)


class CountingPainter:
    """Counts, and paints in grey."""

    name = "grey"

    def __init__(self) -> None:
        self.poses = self.paints = 0

    def pose(self, frame) -> None:
        self.poses += 1

    def paint(self, camera, background) -> np.ndarray:
        self.paints += 1
        return np.full((camera.height, camera.width, 4), 128, np.uint8)


def test_a_moment_is_posed_once_and_equal_views_are_painted_once():
    studio, painter = tiny_studio(), CountingPainter()
    sent = {name: [] for name in "abc"}
    watchers = {name: studio.admit(messages.append) for name, messages in sent.items()}
    studio.hear(watchers["c"], parse_message('{"turn": [0.1, 0]}'))
    assert studio._draw_next(painter, JpegEncoder())
    assert (painter.poses, painter.paints) == (1, 2)
    assert [len(messages) for messages in sent.values()] == [1, 1, 1]


def test_one_too_many_is_told_so_and_let_in_when_another_has_left():
    with serving(limit=2) as served:
        with watching(served), watching(served):
            status, _, body = served.get("/")
            assert status == 503
            assert b"2 people are watching already" in body
            with pytest.raises(InvalidStatus, match="503"), connect(served.url(), proxy=None):
                pass
        until = time.monotonic() + PATIENCE
        while served.studio.is_full and time.monotonic() < until:
            time.sleep(0.02)
        assert served.get("/")[0] == 200


# those who mean no good ----------------------------------------------------------------------------


@pytest.mark.parametrize("message", ["{", b"\x00\x01", '{"ack": NaN}', '{"size": [1e9, 1]}', "[" * 4000])
def test_nonsense_is_hung_up_on_and_the_others_watch_on(served, message):
    with watching(served) as good, watching(served) as bad:
        bad.line.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                bad.line.recv(timeout=PATIENCE)
        assert closed.value.rcvd.code == 1008
        good.picture()


def test_a_message_too_large_is_hung_up_on(served):
    with watching(served) as client:
        client.line.send('{"home": true}' + " " * 10_000)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.line.recv(timeout=PATIENCE)
    assert closed.value.rcvd.code == 1009


def test_a_flood_is_hung_up_on(served):
    with watching(served) as client, pytest.raises(ConnectionClosed):
        for _ in range(20_000):
            client.say(home=True)
        while True:
            client.line.recv(timeout=PATIENCE)


def test_who_connects_and_says_nothing_is_dropped(served, monkeypatch):
    monkeypatch.setattr(server_module, "OPENING_SECONDS", 0.3)
    with serving() as quick, socket.create_connection(("127.0.0.1", quick.port)) as silent:
        silent.settimeout(PATIENCE)
        assert silent.recv(10) == b""


def test_who_does_not_show_what_is_sent_is_dropped(served, monkeypatch):
    monkeypatch.setattr("cap4d.app.serve.flow.STALLED", 0.3)
    with watching(served) as client, pytest.raises(ConnectionClosed):
        while True:
            client.picture(echo=False)


def test_who_does_not_take_what_is_sent_is_dropped(monkeypatch):
    async def send_nothing(*_):
        await asyncio.Event().wait()

    monkeypatch.setattr(PageServer, "_send", send_nothing)
    with (
        serving() as served,
        connect(served.url(), compression=None, proxy=None) as line,
        pytest.raises(ConnectionClosed),
    ):
        for i in range(server_module.MAX_WAITING):  # everybody is told of each, this one included
            line.send(json.dumps({"play": bool(i % 2)}))
        line.recv(timeout=PATIENCE)


def test_connections_have_a_limit(monkeypatch):
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 3)
    with serving() as served:
        lines = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(3)]
        with socket.create_connection(("127.0.0.1", served.port)) as extra:
            extra.settimeout(PATIENCE)
            with contextlib.suppress(ConnectionResetError):
                assert extra.recv(10) == b""
        for line in lines:
            line.close()


# the command ---------------------------------------------------------------------------------------


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_bundle(tiny_bundle(network=False), "tiny.cap4d")
    return tmp_path / "tiny.cap4d"


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("tiny.cap4d --serve nowhere", 2, "serve: expected HOST:PORT"),
        ("tiny.cap4d --serve :0 --headless", 2, "serve: goes without --headless"),
        ("tiny.cap4d --serve :0 --frames 3", 2, "serve: goes without --frames"),
        ("tiny.cap4d --serve :0 --drive nothing.wav", 2, "nothing.wav"),
        ("tiny.cap4d --serve :0 --stats no/s.json", 2, "no/s.json"),
        ("missing.cap4d --serve :0", 1, "missing.cap4d"),
    ],
)
def test_what_cannot_be_served_is_one_line(tiny, capsys, line, code, words):
    assert main(line.split()) == code
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert words in error[0]


def test_a_port_that_is_taken_is_one_line(tiny, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert main(["tiny.cap4d", "--serve", f"127.0.0.1:{taken.getsockname()[1]}"]) == 1
    assert "address already in use" in capsys.readouterr().err


def test_without_websockets_the_extra_is_named(tiny, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "websockets", None)
    assert main(["tiny.cap4d", "--serve", ":0"]) == 2
    assert "cap4d[live]" in capsys.readouterr().err


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


def test_an_interrupt_ends_it_and_writes_the_statistics(tiny):
    with command("--serve", ":0", "--stats", "s.json") as (process, address):
        port = int(address.rpartition(":")[2].strip("/"))
        with connect(f"ws://127.0.0.1:{port}/socket", compression=None, proxy=None) as line:
            client = Client(line)
            for _ in range(5):
                client.picture()
            os.kill(process.pid, signal.SIGINT)
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    line.recv(timeout=PATIENCE)
            assert closed.value.rcvd.code == 1001  # going away
        error = process.stderr.read()
        assert process.wait(PATIENCE) == 130
    assert "Traceback" not in error
    stats = json.loads(Path("s.json").read_text())
    assert stats["serve"]["pictures"] >= 4
    assert 0 < stats["serve"]["latency_ms"]["median"] <= stats["serve"]["latency_ms"]["p95"]
    assert {"jpeg", "splat", "frame"} <= stats["stages"].keys()


def test_a_live_source_moves_the_face_and_is_in_the_statistics(tiny):
    words = ("--serve", ":0", "--drive", "tcp://127.0.0.1:0", "--stats", "s.json", "--size", "64x64")
    with command(*words) as (process, address):
        source = process.told.rpartition(":")[2]
        with connect(f"ws://{address.split('/')[2]}/socket", compression=None, proxy=None) as line:
            client = Client(line)
            assert client.told[0]["hello"]["live"]
            head, still = client.picture()
            assert head["stream"] == "waiting"
            with socket.create_connection(("127.0.0.1", int(source))) as sender:
                moved, number = still, 0
                until = time.monotonic() + PATIENCE
                while head["stream"] != "playing" or difference(still, moved) < 30:
                    assert time.monotonic() < until
                    packet = Packet(number / 30, "tiny", np.float32([1, 1, 1, 1, 1]))
                    sender.sendall(format_packet(packet))
                    head, moved = client.picture()
                    number += 1
        os.kill(process.pid, signal.SIGINT)
        process.stderr.read()
    drive = json.loads(Path("s.json").read_text())["drive"]
    assert drive["received"] >= 1
    assert drive["latency_ms"]["median"] > 0


def difference(a: bytes, b: bytes) -> int:
    """The largest between two JPEGs."""
    return int(np.abs(decoded(a).astype(int) - decoded(b)).max())


# a real browser ------------------------------------------------------------------------------------

needs_chromium = pytest.mark.skipif(
    chromium() is None, reason="no Chromium (Debian: apt-get install chromium)"
)
PIXELS = """(() => {
  const { width, height } = picture;
  return Array.from(picture.getContext("2d").getImageData(0, 0, width, height).data);
})()"""


STANDS = "new Promise((done) => { const n = cap4d.shown; setTimeout(() => done(n === cap4d.shown), 600); })"


def pixels(page) -> np.ndarray:
    width, height = page.evaluate("[picture.width, picture.height]")
    return np.array(page.evaluate(PIXELS)).reshape(height, width, 4)[..., :3]


@needs_chromium
def test_chromium_shows_an_avatar_that_moves_and_its_latency(served, tmp_path):
    with browser(tmp_path) as page:
        page.resize(320, 240)
        page.goto(f"http://127.0.0.1:{served.port}/")
        page.wait_for("window.cap4d && cap4d.shown >= 30")
        first = pixels(page)
        page.wait_for("cap4d.shown >= 34")
        second = pixels(page)
        paper = np.array(
            page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
        )
        assert np.abs(first[0, 0] - paper).max() < 12  # the picture has no edges
        assert (np.abs(first - paper).max(-1) > 40).mean() > 0.05  # somebody is there
        assert np.abs(first - second).max() > 20
        latency, fps = page.evaluate("[cap4d.latency, cap4d.fps]")
        shown = page.wait_for("document.getElementById('figures').textContent")
        assert 0 < latency < 1000
        assert "fps" in shown and "ms" in shown
        print(f"Chromium: {fps:.1f} pictures a second, {latency:.1f} ms to the echo; shows {shown!r}")
        assert page.errors == []


@needs_chromium
def test_in_chromium_hands_turn_pause_and_move_the_face(served, tmp_path):
    with browser(tmp_path) as page:
        page.resize(640, 480)
        page.goto(f"http://127.0.0.1:{served.port}/")
        page.wait_for("window.cap4d && cap4d.shown >= 5")
        page.evaluate("document.getElementById('play').click()")
        page.wait_for("document.body.classList.contains('paused')")
        page.wait_for(STANDS)
        before = pixels(page)
        count = page.evaluate("cap4d.shown")
        page.drag((200, 200), (320, 200))
        page.wait_for(f"cap4d.shown > {count + 1}")
        assert np.abs(pixels(page) - before).max() > 50
        page.evaluate("document.getElementById('faces').click()")
        assert page.evaluate("[...document.querySelectorAll('#sliders label:not([hidden])')].length") == 5
        page.evaluate("search.value = 'BLINK left'; search.dispatchEvent(new Event('input'))")
        assert (
            page.evaluate("document.querySelector('#sliders label:not([hidden])').dataset.name")
            == "eyeBlinkLeft"
        )
        page.evaluate(
            "(() => { const i = document.querySelector('#sliders label:not([hidden]) input');"
            "i.value = 1; i.dispatchEvent(new Event('input')); })()"
        )
        page.wait_for("document.querySelector('#sliders .held output')?.textContent === '1.00'")
        assert served.studio.performance.held == {"eyeBlinkLeft": 1.0}
        page.evaluate("document.getElementById('reset').click()")
        page.evaluate("document.getElementById('play').click()")
        page.wait_for(
            "!document.body.classList.contains('paused') && !document.querySelector('#sliders .held')"
        )
        assert page.errors == []


@needs_chromium
def test_chromium_without_the_token_is_refused_and_with_it_not(tiny, tmp_path):
    with command("--serve", "0.0.0.0:0") as (_, address), browser(tmp_path / "profile") as page:
        port, _, token = address.rpartition(":")[2].partition("/?token=")
        assert len(token) > 20
        here = f"http://127.0.0.1:{port}"
        page.goto(f"{here}/")
        assert "needs the token" in page.evaluate("document.body.innerText")
        answer = page.evaluate(
            f"new Promise((done) => {{ const s = new WebSocket('ws://127.0.0.1:{port}/socket');"
            "s.onopen = () => done('open'); s.onerror = () => done('refused'); })"
        )
        assert answer == "refused"
        page.goto(f"{here}/?token={token}")
        page.wait_for("window.cap4d && cap4d.shown >= 3")


@needs_chromium
def test_chromium_waits_for_a_viewer_that_went_away(tiny, tmp_path):
    with browser(tmp_path / "profile") as page:
        with command("--serve", ":0") as (_, address):
            page.goto(address)
            page.wait_for("window.cap4d && cap4d.shown >= 3")
        page.wait_for("document.getElementById('notice').textContent.includes('is away')")
        with command("--serve", address.split("/")[2]):
            count = page.evaluate("cap4d.shown")
            page.wait_for(f"cap4d.shown > {count} && !document.body.classList.contains('away')")
