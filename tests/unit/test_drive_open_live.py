"""Which sources are live, and which addresses are refused."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.open_live import Address, is_live, open_live, parse_address
from cap4d.drive.packet import Packet
from cap4d.drive.standard_input import StandardInputReceiver
from cap4d.errors import ArgumentError, exit_code


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return tiny_bundle(8, network=False)


@pytest.mark.parametrize(
    "spec", ["-", "tcp://:1", "udp://h:1", "ws://h:1", "livelink://h", "vmc://h", "webcam://0", "http://x"]
)
def test_live_sources(spec) -> None:
    assert is_live(spec)


@pytest.mark.parametrize("spec", [None, "", "fit.npz", "a.npy", "C:/a.npz", "tcp", "tcp:1", "--"])
def test_files_are_not_live(spec) -> None:
    assert not is_live(spec)


@pytest.mark.parametrize(
    ("spec", "address"),
    [
        ("tcp://127.0.0.1:9000", Address("127.0.0.1", 9000)),
        ("tcp://:9000", Address("127.0.0.1", 9000)),
        ("udp://localhost:0/", Address("localhost", 0)),
        ("ws://[::1]:9000", Address("::1", 9000)),
        ("tcp://0.0.0.0:9000?token=a%20b", Address("0.0.0.0", 9000, token="a b")),
        ("tcp://127.0.0.1:9000?token=x", Address("127.0.0.1", 9000, token="x")),
        ("livelink://", Address("127.0.0.1", 11111)),
        ("livelink://0.0.0.0?from=192.168.0.7", Address("0.0.0.0", 11111, sender="192.168.0.7")),
        ("vmc://127.0.0.1:3333", Address("127.0.0.1", 3333)),
    ],
)
def test_addresses(spec, address) -> None:
    assert parse_address(spec) == address


@pytest.mark.parametrize(
    "spec",
    [
        "tcp://127.0.0.1",
        "tcp://127.0.0.1:x",
        "tcp://127.0.0.1:70000",
        "tcp://127.0.0.1:-1",
        "tcp://[::1:9000",
        "tcp://127.0.0.1:9000/path",
        "tcp://me:pw@127.0.0.1:9000",
        "tcp://127.0.0.1:9000?tokn=x",
        "tcp://127.0.0.1:9000?from=1.2.3.4",
        "tcp://127.0.0.1:9000?token=",
        "tcp://0.0.0.0:9000",
        "tcp://0.0.0.0:9000?token=",
        "ws://example.com:9000",
        "udp://[::]:9000",
        "livelink://0.0.0.0:11111",
        "livelink://0.0.0.0:11111?token=x",
        "vmc://192.168.0.1",
    ],
)
def test_what_is_no_address_or_open_to_everybody_is_refused(spec, bundle) -> None:
    with pytest.raises(ArgumentError, match="drive: expected") as caught:
        open_live(spec, bundle)
    assert "\n" not in str(caught.value)


def test_what_is_not_live_or_makes_no_sense_with_it_is_refused(bundle) -> None:
    with pytest.raises(ArgumentError, match="drive: expected"):
        open_live("http://127.0.0.1:1", bundle)
    with pytest.raises(ArgumentError, match="fps: expected none"):
        open_live("tcp://:0", bundle, fps=30)
    with pytest.raises(ArgumentError, match="template: goes with"):
        open_live("webcam://0", bundle, template=Path("neutral.npy"))


def test_a_source_is_converted_and_filled_in_for_the_avatar(bundle) -> None:
    seen = []
    live = open_live("udp://:0", bundle, fillers=lambda frame, now: seen.append(now) or frame)
    with live:
        expr = np.float32([0.5, 0, 0, 0, 0])
        assert live.address.startswith("udp://127.0.0.1:") and not live.address.endswith(":0")
        assert live.packet(Packet(0.0, RIG_NAME, expr=expr), time.monotonic())
        assert not live.packet(Packet(0.1, "other", expr=expr), time.monotonic())
        frame = live.frame(time.monotonic())
        assert frame.expr.shape == (len(EXPRESSIONS),) and len(seen) == 1
        assert live.statistics()["rejected"] == {"rig": 1}


def test_standard_input_is_a_source(bundle, monkeypatch) -> None:
    with open("/dev/null") as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        live = open_live("-", bundle)
        assert isinstance(live.receiver, StandardInputReceiver) and live.address == "-"


def test_a_package_that_is_missing_is_named_with_its_extra(bundle, monkeypatch, capsys) -> None:
    for name in [name for name in sys.modules if name.startswith("websockets")] + ["cap4d.drive.websocket"]:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "websockets", None)
    assert exit_code("cap4d-view", lambda: open_live("ws://:0", bundle)) == 2
    assert "cap4d[live]" in capsys.readouterr().err


@pytest.mark.parametrize("spec", ["tcp://:0", "udp://:0"])
def test_the_first_frame_of_vertices_finds_its_retargeter_there(spec, bundle, monkeypatch) -> None:
    built = []
    monkeypatch.setattr("cap4d.drive.convert.Retargeter", lambda *_: built.append(1) or object())
    with open_live(spec, bundle):
        pass
    assert built == [1]
