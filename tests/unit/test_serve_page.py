"""The page over loopback: what is answered, what is refused, what those are sent who watch."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import time

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("onnx")

from cap4d.app.serve import server as server_module
from cap4d.app.serve.door import Door
from cap4d.app.serve.server import PageServer
from served_page import PATIENCE, Client, decoded, serving, watching
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

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


def test_a_paused_picture_is_sent_once_a_drag_sends_another_and_home_the_first_again(served):
    with watching(served) as client:
        client.say(play=False, seek=0.1, size=[100, 100])
        until = time.monotonic() + PATIENCE
        while True:
            assert time.monotonic() < until
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
            client.until(lambda state: state.get("held") == {"jawOpen": 0.75})
        one.say(reset=True, expr={"jawOpen": None})
        other.until(lambda state: state.get("held") == {})


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
    with watching(served) as client, pytest.raises(ConnectionClosed) as closed:
        for _ in range(20_000):
            client.say(home=True)
        while True:
            client.line.recv(timeout=PATIENCE)
    assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "expected fewer messages")


def test_who_connects_and_says_nothing_is_dropped(monkeypatch):
    monkeypatch.setattr(server_module, "OPENING_SECONDS", 0.3)
    with serving() as quick, socket.create_connection(("127.0.0.1", quick.port)) as silent:
        silent.settimeout(6.0)  # the package's own patience is 10 s
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
    monkeypatch.setattr("cap4d.app.serve.flow.STALLED", float("inf"))  # that would drop it as well, later
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
    monkeypatch.setattr(server_module, "OPENING_SECONDS", 2 * PATIENCE)  # after it all are hung up on
    with serving() as served:
        lines = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(3)]
        with socket.create_connection(("127.0.0.1", served.port)) as extra:
            extra.settimeout(PATIENCE)
            with contextlib.suppress(ConnectionResetError):
                assert extra.recv(10) == b""
        for line in lines:
            line.setblocking(False)
            with pytest.raises(BlockingIOError):  # still open
                line.recv(10)
            line.close()
