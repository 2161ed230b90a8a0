"""cap4d-view --headless with a live source: from lines of JSON to a file and its statistics."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from cap4d.app.main import main
from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle
from wav_files import click, write_wav

from cap4d.bundle import write_bundle
from cap4d.drive.packet import Packet
from cap4d.drive.wire import format_packet


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A current folder that holds tiny.cap4d."""
    write_bundle(tiny_bundle(), tmp_path / "tiny.cap4d")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def line(t: float) -> bytes:
    expr = np.full(len(EXPRESSIONS), 0.5 + 0.5 * np.sin(12 * t), np.float32)
    return format_packet(Packet(t, RIG_NAME, expr=expr))


def view(options: str) -> int:
    return main(f"tiny.cap4d --headless --backend cpu --size 64x64 {options}".split())


def test_lines_on_standard_input_become_a_video_and_statistics(folder, monkeypatch) -> None:
    reader, writer = os.pipe()
    with open(reader, "rb") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        os.write(writer, b"".join(line(i / 60) for i in range(30)) + b"garbage\n")
        os.close(writer)
        assert view("--drive - --fps 25 --out out.mp4 --stats stats.json") == 0
    stats = json.loads((folder / "stats.json").read_text())
    drive = stats["drive"]
    assert drive["source"] == "-" and drive["received"] == 31 and drive["rejected"] == {"syntax": 1}
    assert drive["shown"] + drive["dropped"] == 30 and drive["shown"] > 5
    assert 10 < drive["latency_ms"]["median"] < 500
    assert 1.4 < stats["frames"] / 25 < 3  # half a second played, then held, and eased to neutral
    import av

    with av.open("out.mp4") as container:
        images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(images) == stats["frames"] and np.ptp(np.float32(images), axis=0).max() > 20


def test_a_sender_over_tcp_is_drawn_for_as_many_pictures_as_asked_for(folder, caplog) -> None:
    caplog.set_level("INFO")
    stop = threading.Event()

    def send() -> None:
        while not (found := [m for m in caplog.messages if m.startswith("listening at tcp://")]):
            time.sleep(0.01)
        with socket.create_connection(("127.0.0.1", urlsplit(found[0].split()[-1]).port)) as sock:
            start = time.monotonic()
            while not stop.wait(1 / 60):
                try:
                    sock.sendall(line(time.monotonic() - start))
                except OSError:
                    return

    sender = threading.Thread(target=send)
    sender.start()
    try:
        assert view("--drive tcp://127.0.0.1:0 --frames 40 --out frame_%03d.png --stats stats.json") == 0
    finally:
        stop.set()
        sender.join()
    stats = json.loads((folder / "stats.json").read_text())
    assert len(list(folder.glob("frame_*.png"))) == 40 == stats["frames"]
    assert 1.2 < stats["seconds"] < 4  # real time at 30 a second, whatever the machine could
    assert stats["drive"]["received"] > 30 and stats["drive"]["interpolated"] > 10


def test_ctrl_c_ends_the_file_where_it_is(folder, caplog) -> None:
    timer = threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    assert view("--drive udp://127.0.0.1:0 --out out.mp4 --stats stats.json") == 0
    timer.join()
    assert (folder / "out.mp4").stat().st_size > 500
    assert json.loads((folder / "stats.json").read_text())["drive"]["state"] == "waiting"
    assert "no frame came that could be shown" in caplog.text


def test_a_sound_goes_into_the_file_of_a_live_source(folder) -> None:
    import av

    write_wav(folder / "a.wav", click(0.1, seconds=2), 48000)
    assert view("--drive udp://127.0.0.1:0 --frames 15 --out out.mp4 --audio a.wav") == 0
    with av.open("out.mp4") as container:
        heard = np.concatenate([frame.to_ndarray().ravel() for frame in container.decode(audio=0)])
    assert len(heard) / 48000 == pytest.approx(0.5, abs=0.1) and np.abs(heard).max() > 0.1


@pytest.mark.parametrize(
    "options",
    [
        "--drive tcp://0.0.0.0:9000",
        "--drive foo://127.0.0.1:9000",
        "--drive tcp://127.0.0.1:0 --out frame_%03d.png --audio a.wav",
        "--drive udp://127.0.0.1:x",
        "--drive tcp://127.0.0.1:0 --pipeline",
        "--drive tcp://127.0.0.1:0 --out out.avi",
        "--drive tcp://127.0.0.1:0 --out one.png",
        "--drive tcp://127.0.0.1:0 --stats nowhere/stats.json",
    ],
)
def test_what_cannot_be_is_said_in_one_line(folder, options, capsys) -> None:
    assert view(options) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert {path.name for path in folder.iterdir()} == {"tiny.cap4d"}
