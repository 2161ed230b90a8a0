"""A sender on a clock of its own, and every target over loopback."""

from __future__ import annotations

import io
import json
import logging
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from cap4d import cli
from cap4d.drive.arkit import NAMES
from cap4d.drive.head_turn import head_pose, turn
from cap4d.drive.impair import BadLine, Impairment
from cap4d.drive.livelink import parse_livelink
from cap4d.drive.livelink_format import format_livelink
from cap4d.drive.packet import Packet
from cap4d.drive.recording import Recording
from cap4d.drive.send import LineSource, RecordedSource, Sender, Transmission, send
from cap4d.drive.target import Target, open_target
from cap4d.drive.wire import format_packet, parse_packet
from cap4d.errors import ArgumentError

GOOD = Impairment()


class FakeClock:
    """Time that passes only by sleeping."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, 1e-4)


class Viewer:
    """Hears what is sent while it is there.

    Args:
        away: (from, to) s between which nobody is.
    """

    def __init__(self, clock: FakeClock, away: tuple[float, float] = (0.0, 0.0)) -> None:
        self.clock, self.away, self.tries = clock, away, []
        self.heard: list[tuple[float, bytes]] = []

    def connect(self) -> Viewer:
        self.tries.append(self.clock())
        self._check()
        return self

    def send(self, message: bytes) -> None:
        self._check()
        self.heard.append((self.clock(), message))

    def close(self) -> None:
        pass

    def _check(self) -> None:
        if self.away[0] <= self.clock() < self.away[1]:
            raise ConnectionRefusedError("away")


def recording(count: int = 60, fps: float = 30.0) -> Recording:
    return Recording("expr", fps, count, lambda i, t: Packet(t, "tiny", np.float32([i])))


def sender(
    clock: FakeClock, viewer: Viewer, impairment: Impairment = GOOD, *, count: int = 60, **options
) -> Sender:
    source = RecordedSource(recording(count), format_packet, sleep=clock.sleep, **options)
    target = Target("nowhere", viewer.connect)
    line = BadLine(impairment, frame_time=source.frame_time)
    return Sender(source, line, target, clock=clock, sleep=clock.sleep)


def test_frames_leave_at_their_time_with_their_time_on_them():
    clock = FakeClock()
    viewer = Viewer(clock)
    sender(clock, viewer).run()
    packets = [parse_packet(message) for _, message in viewer.heard]
    assert [int(packet.expr[0]) for packet in packets] == list(range(60))
    for i, ((at, _), packet) in enumerate(zip(viewer.heard, packets, strict=True)):
        assert packet.t == pytest.approx(i / 30)
        assert i / 30 - 1e-6 <= at - 100 <= i / 30 + 1e-3


def test_speed_is_the_streams_own():
    clock = FakeClock()
    viewer = Viewer(clock)
    sender(clock, viewer, speed=2.0).run()
    assert parse_packet(viewer.heard[-1][1]).t == pytest.approx(59 / 60)
    assert viewer.heard[-1][0] - 100 == pytest.approx(59 / 60, abs=2e-3)


def test_a_loop_goes_on_on_the_same_clock():
    clock = FakeClock()
    source = RecordedSource(recording(10), format_packet, loop=True, sleep=clock.sleep)
    messages = [parse_packet(m) for now in 100 + np.arange(60) / 30 for _, m in source.take(now + 1e-6)]
    assert [int(packet.expr[0]) for packet in messages] == [i % 10 for i in range(60)]
    assert messages[-1].t == pytest.approx(59 / 30)
    assert not source.done


def test_the_first_frame_waits_for_the_viewer_with_longer_and_longer_waits(caplog):
    caplog.set_level(logging.INFO)
    clock = FakeClock()
    viewer = Viewer(clock, away=(100.0, 105.0))
    sender(clock, viewer).run()
    assert len(viewer.heard) == 60
    waits = np.diff(viewer.tries)
    assert np.allclose(waits[:4], [0.1, 0.2, 0.4, 0.8], atol=0.06)
    assert max(waits) < 2.1
    assert "waiting for the viewer (away)" in caplog.text


def test_a_viewer_that_goes_misses_what_is_sent_meanwhile_and_comes_back():
    clock = FakeClock()
    viewer = Viewer(clock, away=(100.5, 101.0))
    sending = sender(clock, viewer)
    sending.run()
    heard = [parse_packet(message).t for _, message in viewer.heard]
    assert sending.target.connections == 2
    assert sending.sent == len(heard)
    assert sending.sent + sending.unheard == 60
    assert 15 <= sending.unheard <= 35
    assert max(heard) == pytest.approx(59 / 30)
    assert "connected 2 times" in sending.summary()


def test_impaired_frames_are_counted_and_the_last_late_one_is_waited_for():
    clock = FakeClock()
    viewer = Viewer(clock)
    sending = sender(clock, viewer, Impairment(loss=0.1, jitter=0.2, duplicate=0.1), count=300)
    sending.run()
    counts = sending.line.counts
    assert sending.sent == len(viewer.heard) == 300 - counts["lost"] + counts["doubled"]
    assert f"{counts['lost']} lost, {counts['doubled']} doubled" in sending.summary()


def test_a_frame_too_large_for_the_target_is_one_refusal():
    clock = FakeClock()
    sending = sender(clock, Viewer(clock))
    sending.target.largest = 20
    with pytest.raises(ArgumentError, match="does not fit into a datagram"):
        sending.run()
    assert sending.sent == 0


# lines of standard input ---------------------------------------------------------------------------


def read_all(source: LineSource) -> list[bytes]:
    messages = []
    while not source.done:
        messages += [message for _, message in source.take(0.0)]
        source.wait(1.0)
    return messages


def test_lines_are_passed_on_as_they_are():
    lines = [b'{"t":1,"expr":[1],"rig":"r"}\n', b"garbage\n", b"\n", b"no newline at the end"]
    assert read_all(LineSource(io.BytesIO(b"".join(lines)), bytes)) == [*lines[:3], lines[3] + b"\n"]


def test_a_line_without_end_is_left_out_and_the_next_is_whole():
    source = LineSource(io.BytesIO(b"x" * (3 << 20) + b"\nshort\n"), bytes)
    assert read_all(source) == [b"short\n"]
    assert source.refused == 1


def test_lines_that_cannot_be_said_are_counted():
    source = LineSource(io.BytesIO(b"a\nb\n"), lambda line: None if line == b"a\n" else line)
    assert read_all(source) == [b"b\n"]
    assert source.refused == 1


# targets, over loopback ----------------------------------------------------------------------------


@pytest.fixture
def fit(tmp_path: Path) -> str:
    path = tmp_path / "fit.npz"
    np.savez(path, expr=np.arange(20.0).reshape(10, 2), eye_rot=np.zeros((10, 3)), fps=200, rig_name="tiny")
    return str(path)


def frames(data: bytes) -> list[Packet]:
    return [parse_packet(line) for line in data.splitlines()]


def test_tcp_carries_the_token_first_then_every_frame(fit):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        thread = threading.Thread(
            target=send, args=(Transmission(fit, f"tcp://127.0.0.1:{port}", token="s"),)
        )
        thread.start()
        viewer, _ = server.accept()
        with viewer, viewer.makefile("rb") as stream:
            first, *rest = stream.read().splitlines()
        thread.join()
    assert json.loads(first) == {"token": "s"}
    assert [list(packet.expr) for packet in map(parse_packet, rest)] == [
        [2 * i, 2 * i + 1] for i in range(10)
    ]


def test_tcp_comes_back_to_a_viewer_that_hung_up():
    target = None
    with socket.create_server(("127.0.0.1", 0)) as server:
        target = open_target(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        assert target.send(b"a\n", 0.0)
        viewer, _ = server.accept()
        assert viewer.recv(10) == b"a\n"
        viewer.close()
        time.sleep(0.05)  # the hang-up is on its way
        assert not target.send(b"b\n", 1.0)
        assert not target.send(b"c\n", 1.05)  # too early to try again
        assert target.send(b"d\n", 1.2)
        viewer, _ = server.accept()
        assert viewer.recv(10) == b"d\n"
        viewer.close()
        target.close()


def test_udp_carries_the_token_in_every_datagram(fit):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as viewer:
        viewer.bind(("127.0.0.1", 0))
        viewer.settimeout(5)
        send(Transmission(fit, f"udp://127.0.0.1:{viewer.getsockname()[1]}?token=s"))
        datagrams = [viewer.recv(65536) for _ in range(10)]
    assert all(json.loads(datagram)["token"] == "s" for datagram in datagrams)
    assert [packet.t for packet in frames(b"".join(datagrams))] == pytest.approx([i / 200 for i in range(10)])


def test_nobody_at_a_udp_port_stops_nothing(fit):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    send(Transmission(fit, f"udp://127.0.0.1:{port}"))


def test_a_websocket_gets_a_message_a_frame_and_the_token_in_its_address(fit):
    pytest.importorskip("websockets")
    from websockets.sync.server import serve

    heard: list[object] = []

    def hear(socket) -> None:
        heard.append(socket.request.path)
        heard.extend(socket)

    with serve(hear, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        port = server.socket.getsockname()[1]
        send(Transmission(fit, f"ws://127.0.0.1:{port}/live", token="s & s"))
        server.shutdown()
        thread.join()
    assert heard[0] == "/live?token=s+%26+s"
    assert [packet.t for packet in frames("".join(heard[1:]).encode())] == pytest.approx(
        [i / 200 for i in range(10)]
    )


def test_garbage_to_a_websocket_that_hung_up_is_a_failure_to_send():
    pytest.importorskip("websockets")
    from websockets.sync.server import serve

    with serve(lambda socket: None, "127.0.0.1", 0) as server:  # hangs up at once
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        target = open_target(f"ws://127.0.0.1:{server.socket.getsockname()[1]}")
        assert target.connected(0.0)
        end = time.monotonic() + 5
        while sent := target.send(b"\xff\n", 0.0):
            assert time.monotonic() < end
        server.shutdown()
        thread.join()
    assert not sent and "1000" in target.reason


def test_a_websocket_that_refuses_says_why():
    pytest.importorskip("websockets")
    from websockets.sync.server import serve

    refuse = lambda connection, _: connection.respond(403, "no token\n")  # noqa: E731
    with serve(lambda socket: None, "127.0.0.1", 0, process_request=refuse) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        target = open_target(f"ws://127.0.0.1:{server.socket.getsockname()[1]}")
        assert not target.send(b"{}\n", 0.0)
        server.shutdown()
        thread.join()
    assert "403" in target.reason


def test_live_link_face_packets_are_written_byte_by_byte():
    arkit = np.zeros(52, np.float32)
    arkit[NAMES.index("jawOpen")] = 0.5
    data = format_livelink(Packet(2.5, arkit=arkit), device="ab", subject="cde")
    assert data[:14] == b"\x06\x00\x00\x00\x02ab\x00\x00\x00\x03cde"
    assert struct.unpack(">ifii", data[14:30]) == (150, 0.0, 60, 1)
    assert data[30] == 61
    values = struct.unpack(">61f", data[31:])
    assert values == (*arkit.tolist(), *[0.0] * 9)


@pytest.mark.parametrize(("t", "of_day"), [(1.8e9 + 0.5, 28800.5), (-1.0, 86399.0), (1e11, 35200.0)])
def test_any_time_becomes_a_time_code_of_the_day(t, of_day):
    back = parse_livelink(format_livelink(Packet(t, arkit=np.zeros(52, np.float32))))
    assert back.t == pytest.approx(of_day, abs=1e-4)


def test_what_is_written_is_read_back_gaze_and_head_too():
    rng = np.random.default_rng(0)
    eyes = turn(0.3, -0.2)
    packet = Packet(
        1.25, arkit=rng.random(52).astype(np.float32), eye_rot=eyes, **head_pose(turn(0.5, 0.3, -0.2))
    )
    back = parse_livelink(format_livelink(packet))
    assert back.t == 1.25
    np.testing.assert_array_equal(back.arkit, packet.arkit)
    for name in ("eye_rot", "rot", "tra", "neck_rot"):
        np.testing.assert_allclose(getattr(back, name), getattr(packet, name), atol=1e-6)


def test_a_head_with_a_place_in_a_world_has_no_angles_for_it():
    packet = Packet(0.0, arkit=np.ones(52, np.float32), rot=np.float32([0, 3, 0]), tra=np.float32([0, 0, 1]))
    assert parse_livelink(format_livelink(packet)).rot is None


def test_lines_become_live_link_face_packets(monkeypatch):
    lines = b'{"t": 1, "arkit": {"jawOpen": 0.5}}\n{"t": 2, "rig": "tiny", "expr": [1]}\nno\n'
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(lines)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as viewer:
        viewer.bind(("127.0.0.1", 0))
        viewer.settimeout(5)
        send(Transmission("-", f"livelink://127.0.0.1:{viewer.getsockname()[1]}"))
        data = viewer.recv(4096)
        viewer.setblocking(False)
        with pytest.raises(BlockingIOError):
            viewer.recv(4096)
    assert struct.unpack(">61f", data[-244:])[NAMES.index("jawOpen")] == 0.5


# the command ---------------------------------------------------------------------------------------


def test_the_command_prints_lines(fit, capfdbinary):
    assert cli.main(["drive", fit, "--to", "-"]) == 0
    assert len(frames(capfdbinary.readouterr().out)) == 10


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["fit.npz", "--to", "http://127.0.0.1:1"], 2, "to: expected tcp://"),
        (["fit.npz", "--to", "tcp://127.0.0.1"], 2, "to: expected tcp://"),
        (["fit.npz", "--to", "tcp://127.0.0.1:99999"], 2, "to: expected tcp://"),
        (["fit.npz", "--to", "-", "--impair", "loss=2"], 2, "impair: expected a share"),
        (["fit.npz", "--to", "-", "--speed", "0"], 2, "speed: expected a number"),
        (["fit.npz", "--to", "-", "--seed", "-1"], 2, "seed: expected 0 or more"),
        (["fit.npz", "--to", "livelink://127.0.0.1:1"], 2, "--avatar"),
        (["fit.npz", "--to", "livelink://127.0.0.1:1", "--as", "expr"], 2, "Live Link Face carries"),
        (["missing.npz", "--to", "-"], 1, "missing.npz"),
        (["-", "--to", "-", "--loop"], 2, "passed on when they come"),
    ],
)
def test_what_cannot_be_sent_is_one_line(fit, monkeypatch, capsys, words, code, expected):
    monkeypatch.chdir(Path(fit).parent)
    assert cli.main(["drive", *words]) == code
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert expected in error[0]


def test_without_websockets_the_extra_is_named(fit, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "websockets", None)
    assert cli.main(["drive", fit, "--to", "ws://127.0.0.1:1"]) == 2
    assert "cap4d[live]" in capsys.readouterr().err


def test_a_reader_that_goes_away_is_one_line(fit):
    command = [sys.executable, "-m", "cap4d.cli", "drive", fit, "--to", "-", "--loop"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.close()
        error = process.stderr.read().decode().splitlines()
    assert process.returncode == 1
    assert error[-1] == "cap4d: standard output: nobody reads it any more"
    assert not [line for line in error if "Traceback" in line]


def test_an_interrupt_ends_it_with_what_was_sent(fit):
    command = [sys.executable, "-m", "cap4d.cli", "drive", fit, "--to", "-", "--loop"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        os.kill(process.pid, 2)
        process.stdout.read()
        error = process.stderr.read().decode().splitlines()
    assert process.returncode == 130
    assert error[-1] == "cap4d: interrupted"
    assert " sent" in error[-2]
