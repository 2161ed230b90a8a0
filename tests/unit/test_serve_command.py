"""cap4d-view --serve from its command line to its statistics."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("onnx")

from cap4d.app.main import main
from served_page import PATIENCE, Client, command, decoded
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from cap4d.drive.packet import Packet
from cap4d.drive.wire import format_packet


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
