"""Frames as lines of JSON: what comes back, and each way in which a line can be wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cap4d.drive.arkit import NAMES
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.drive.wire import (
    MAX_LINE,
    MAX_VERTICES,
    LineSplitter,
    check_token,
    format_packet,
    format_token,
    lines_of,
    parse_object,
    parse_packet,
)


def refused(line: bytes) -> Cause:
    with pytest.raises(Rejected) as caught:
        parse_packet(line)
    assert len(str(caught.value)) < 600
    return caught.value.cause


def frame(**changes: object) -> bytes:
    value = {"t": 1.5, "rig": "tiny", "expr": [0.1, 0.2]} | changes
    return json.dumps({k: v for k, v in value.items() if v is not None}).encode()


@pytest.mark.parametrize(
    "kind", [{"expr": (7,), "rig_name": "tiny"}, {"arkit": (52,)}, {"vertices": (11, 3)}], ids=str
)
def test_a_frame_comes_back_to_the_bit(kind) -> None:
    rng = np.random.default_rng(0)
    values = {k: v if isinstance(v, str) else rng.normal(size=v).astype(np.float32) for k, v in kind.items()}
    turns = {
        name: rng.normal(size=3).astype(np.float32) for name in ("eye_rot", "neck_rot", "jaw_rot", "rot")
    }
    sent = Packet(1234567890.123456, **values, **turns)
    line = format_packet(sent)
    got = parse_packet(line)
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    assert got.t == sent.t and got.rig_name == sent.rig_name and got.tra is None
    for name in [*(set(kind) - {"rig_name"}), *turns]:
        assert getattr(got, name).dtype == np.float32
        np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))


def test_arkit_names_that_are_left_out_are_zero() -> None:
    got = parse_packet(b'{"t": 0, "arkit": {"jawOpen": 0.5}}').arkit
    assert got[NAMES.index("jawOpen")] == 0.5 and got.sum() == 0.5
    assert not parse_packet(format_packet(Packet(0.0, arkit=np.zeros(52)))).arkit.any()


def test_whole_numbers_and_other_keys_are_as_good() -> None:
    got = parse_packet(b'{"t": 3, "rig": "tiny", "expr": [1, 2], "comment": {"a": [null]}, "tra": [0, 0, 1]}')
    assert got.t == 3.0 and got.expr.tolist() == [1, 2] and got.tra.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("line", "cause"),
    [
        (b"", Cause.SYNTAX),
        (b"hello", Cause.SYNTAX),
        (b"[1, 2]", Cause.SYNTAX),
        (b"\xff\xfe{}", Cause.SYNTAX),
        (frame()[:-1], Cause.SYNTAX),
        (b"[" * 5000, Cause.SYNTAX),
        (b'{"t": 1, "expr": ' + b"[" * 60 + b"]" * 60 + b"}", Cause.FIELD),
        (b" " * MAX_LINE + frame(), Cause.SIZE),
        (frame(expr=[0] * 6000), Cause.SIZE),
        (frame(t=None), Cause.TIME),
        (frame(t="1"), Cause.TIME),
        (frame(t=True), Cause.TIME),
        (frame(t=float("nan")), Cause.TIME),
        (frame(t=float("inf")), Cause.TIME),
        (b'{"t": 1e999, "expr": [0], "rig": "a"}', Cause.TIME),
        (b'{"t": ' + b"9" * 5000 + b', "expr": [0], "rig": "a"}', Cause.TIME),
        (frame(expr=None), Cause.FIELD),
        (frame(arkit={"jawOpen": 1}), Cause.FIELD),
        (frame(rig=None), Cause.FIELD),
        (frame(rig="x" * 1000), Cause.FIELD),
        (frame(rig=3), Cause.FIELD),
        (frame(expr="abc"), Cause.FIELD),
        (frame(expr=[True, False]), Cause.FIELD),
        (frame(expr=[[1], [2]]), Cause.FIELD),
        (frame(expr=[None]), Cause.FIELD),
        (frame(expr=[]), Cause.SHAPE),
        (frame(expr=[0] * 4097), Cause.SHAPE),
        (frame(expr=[float("nan"), 0]), Cause.NOT_FINITE),
        (frame(expr=[float("-inf"), 0]), Cause.NOT_FINITE),
        (b'{"t": 1, "rig": "a", "expr": [' + b"9" * 4000 + b"]}", Cause.NOT_FINITE),
        (frame(expr=[1e30, 0]), Cause.NOT_FINITE),
        (frame(rot=[0, 0]), Cause.SHAPE),
        (frame(rot={"x": 1}), Cause.FIELD),
        (frame(tra=[0, 0, float("nan")]), Cause.NOT_FINITE),
        (b'{"t": 1, "t": 2, "rig": "a", "expr": [0]}', Cause.FIELD),
        (b'{"t": 1, "arkit": {"jawOpen": 1, "jawOpen": 0}}', Cause.FIELD),
        (frame(expr=None, arkit={"jawopen": 1}), Cause.FIELD),
        (frame(expr=None, arkit={"jawOpen": "1"}), Cause.FIELD),
        (frame(expr=None, arkit=[0] * 52), Cause.FIELD),
        (frame(expr=None, arkit={"jawOpen": float("nan")}), Cause.NOT_FINITE),
        (frame(expr=None, vertices=[1, 2, 3]), Cause.FIELD),
        (frame(expr=None, vertices="!!!!"), Cause.FIELD),
        (frame(expr=None, vertices="äöü"), Cause.FIELD),
        (frame(expr=None, vertices=""), Cause.SHAPE),
        (frame(expr=None, vertices="AAAAAAAAAAAAAAAAAAAA"), Cause.SHAPE),
        (frame(expr=None, vertices="AADAfwAAwH8AAMB/"), Cause.NOT_FINITE),
    ],
)
def test_what_is_no_sound_frame_is_refused_with_its_cause(line, cause) -> None:
    assert refused(line) == cause


def test_more_vertices_than_any_head_has_are_refused() -> None:
    line = format_packet(Packet(0.0, vertices=np.zeros((MAX_VERTICES + 1, 3))))
    assert len(line) <= MAX_LINE and refused(line.strip()) == Cause.SHAPE


def test_a_token_is_asked_for() -> None:
    check_token(parse_object(format_token("söcret")), "söcret")
    check_token({}, None)
    for value in ({}, {"token": "secre"}, {"token": 3}, {"token": "\ud800"}):
        with pytest.raises(Rejected) as caught:
            check_token(value, "secret")
        assert caught.value.cause == Cause.TOKEN
    packet = Packet(0.0, arkit=np.zeros(52, np.float32))
    assert parse_object(format_packet(packet, token="x"))["token"] == "x"
    assert parse_packet(format_packet(packet, token="x")).t == 0


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 1000])
def test_lines_come_out_whole_however_they_come_in(chunk) -> None:
    data, splitter = (
        b"one\n\n  \ntwo\r\n" + b"x" * 21 + b"\nthree\n" + b"y" * 20 + b"\nrest",
        LineSplitter(20),
    )
    parts = [data[i : i + chunk] for i in range(0, len(data), chunk)]
    lines = [line for part in parts for line in splitter.feed(part)]
    assert lines == [b"one", b"two\r", None, b"three", b"y" * 20]
    assert list(splitter.feed(b"\n")) == [b"rest"]


def test_a_line_without_end_holds_no_memory() -> None:
    splitter = LineSplitter(1000)
    lines = [line for _ in range(10_000) for line in splitter.feed(b"z" * 999)]
    assert lines == [None] and len(splitter._held) <= 1000
    assert list(splitter.feed(b"zz\nnext\n")) == [b"next"]


def test_blank_lines_cost_as_others_do_but_for_the_odd_one() -> None:
    splitter = LineSplitter()
    assert list(splitter.feed(b"\none\n\ntwo\r\n \r\n\nthree\n\n")) == [b"one", b"two\r", b"three"]
    assert len(list(splitter.feed(b"\n" * 100))) == 99
    assert list(splitter.feed(b"four\n\n")) == [b"four"]
    assert lines_of(b"\none\n\ntwo\r\n\n") == [b"one", b"", b"two"] and lines_of(b" \r\n" * 100) == []
