"""Who may look, and what a page may say. No sockets."""

from __future__ import annotations

import json

import pytest
from cap4d.app.options import parse_options
from cap4d.app.serve.door import Door, is_loopback, parse_address
from cap4d.app.serve.message import BadMessageError, parse_message
from cap4d.app.serve.server import Meter, SingleHeaders

from cap4d.errors import ArgumentError

HOST = {"Host": "127.0.0.1:8300"}
ORIGIN = HOST | {"Origin": "http://127.0.0.1:8300"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:8300", ("127.0.0.1", 8300)),
        (":0", ("127.0.0.1", 0)),
        ("[::1]:80", ("::1", 80)),
        ("myhost:8300", ("myhost", 8300)),
    ],
)
def test_addresses_are_read(text, expected):
    assert parse_address(text) == expected


@pytest.mark.parametrize("text", ["", "127.0.0.1", "8300", "a:b", "a:99999", "a:1/x", "http://a:1", "u@a:1"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(ArgumentError, match="serve: expected HOST:PORT"):
        parse_address(text)


def test_only_this_machines_own_addresses_are_loopback():
    assert all(map(is_loopback, ("127.0.0.1", "127.1.2.3", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.1.2", "localhost.evil.org", "myhost", "")))


def test_loopback_needs_no_token_unless_one_is_named():
    assert Door("127.0.0.1").refusal("/", HOST) is None
    assert Door("127.0.0.1").address(8300) == "http://127.0.0.1:8300/"
    named = Door("127.0.0.1", "s")
    assert named.refusal("/", HOST).status == 403
    assert named.refusal("/?token=s", HOST) is None


@pytest.mark.parametrize("path", ["/", "/socket"])
@pytest.mark.parametrize(
    "query", ["", "?", "?token=", "?token=S", "?token=secre", "?token=secret2", "?tok=secret"]
)
def test_another_address_refuses_all_but_the_token(path, query):
    door = Door("0.0.0.0", "secret")
    assert door.refusal(path + query, {"Host": "192.168.1.2:8300"}).status == 403
    assert door.refusal(f"{path}?token=secret", {"Host": "192.168.1.2:8300"}) is None


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_an_empty_token_opens_nothing(host):
    with pytest.raises(ArgumentError, match="token: expected a word, got none"):
        Door(host, "")


def test_a_token_is_made_up_where_none_is_named_and_stands_in_the_address():
    doors = Door("192.168.1.2"), Door("192.168.1.2")
    assert doors[0].token != doors[1].token
    assert len(doors[0].token) >= 20
    assert doors[0].address(9) == f"http://192.168.1.2:9/?token={doors[0].token}"


@pytest.mark.parametrize(
    "host", ["evil.org:8300", "evil.org", "", "127.0.0.1.evil.org", "192.168.1.2:8300", "["]
)
def test_on_loopback_a_name_that_is_not_this_machines_is_refused(host):
    assert Door("127.0.0.1").refusal("/", {"Host": host}).status == 403
    assert Door("127.0.0.1").refusal("/socket", {"Host": host, "Origin": f"http://{host}"}).status == 403


@pytest.mark.parametrize(
    "origin", ["http://evil.org", "null", "http://127.0.0.1:9999", "http://localhost:8300", ""]
)
def test_only_the_page_itself_may_connect(origin):
    assert Door("127.0.0.1").refusal("/socket", HOST | {"Origin": origin}).status == 403
    assert Door("127.0.0.1").refusal("/socket", ORIGIN) is None
    assert Door("127.0.0.1").refusal("/socket", HOST) is None  # not a browser, which always says


@pytest.mark.parametrize(
    "target",
    [
        "/../door.py",
        "/door.py",
        "/page.html",
        "//",
        "",
        "*",
        "/page.js/..",
        "/%70age.js",
        "/etc/passwd",
        "/?" + "x" * 600,
    ],
)
def test_nothing_but_the_known_files_is_there(target):
    assert Door("127.0.0.1").refusal(target, HOST).status == 404


def test_a_header_that_is_there_twice_is_not_believed():
    class Headers:
        def raw_items(self):
            return [("host", "127.0.0.1"), ("Host", "evil.org"), ("origin", "x")]

    assert SingleHeaders(Headers()) == {"Host": "", "Origin": "x"}


# messages ------------------------------------------------------------------------------------------


def test_a_message_says_what_it_says():
    words = {"ack": 3, "size": [640, 480], "turn": [0.5, -1], "zoom": 1.5, "play": False, "seek": 2}
    message = parse_message(json.dumps(words | {"expr": {"jawOpen": 0.5, "smile": None}, "home": True}))
    assert (message.ack, message.size, message.turn, message.zoom) == (3, (640, 480), (0.5, -1.0), 1.5)
    assert (message.play, message.seek, message.home) == (False, 2.0, True)
    assert message.expr == {"jawOpen": 0.5, "smile": None}
    assert message.pan is message.background is None
    assert parse_message("{}").expr == {}


@pytest.mark.parametrize(
    "text",
    ["", "x", "[]", "null", '{"ack": -1}', '{"ack": NaN}', '{"ack": 1e999}', '{"ack": true}', '{"ack": "1"}']
    + ['{"size": [1]}', '{"size": [0, 5]}', '{"size": [1e9, 5]}', '{"turn": [1, null]}', '{"play": 1}']
    + ['{"expr": {"a": "b"}}', '{"expr": {"a": Infinity}}', '{"expr": []}', '{"unknown": 1}', '{"seek": -1}']
    + ['{"background": [0, 0, 2]}', "[" * 4000, '{"home": true}' + " " * 5000]
    + [json.dumps({"expr": {str(i): 1 for i in range(65)}}), '{"ack": ' + "9" * 4000 + "}"],
)
def test_anything_else_is_a_bad_message(text):
    with pytest.raises(BadMessageError):
        parse_message(text)
    with pytest.raises(BadMessageError):
        parse_message(text.encode())  # the page sends text


def test_a_flood_is_counted_by_the_second():
    meter = Meter(3)
    assert [meter.allows(1.0 + i / 10) for i in range(5)] == [True, True, True, False, False]
    assert meter.allows(2.0)


# the command line ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "avatar", "serve"),
    [
        ("me.cap4d --serve", "me.cap4d", "127.0.0.1:8300"),
        ("--serve me.cap4d", "me.cap4d", "127.0.0.1:8300"),
        ("me.cap4d --serve 0.0.0.0:9", "me.cap4d", "0.0.0.0:9"),
        ("--serve :9 --token x", None, ":9"),
        ("--serve", None, "127.0.0.1:8300"),
        ("me.cap4d", "me.cap4d", None),
    ],
)
def test_the_address_is_optional_and_the_avatar_too(line, avatar, serve):
    options = parse_options(line.split())
    assert (options.avatar and str(options.avatar), options.serve) == (avatar, serve)
