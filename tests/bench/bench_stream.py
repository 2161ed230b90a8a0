"""Live driving: how old pictures are, what a bad line costs, and an hour of hostile senders.

    OPENBLAS_NUM_THREADS=1 python -m pytest -m bench -s tests/bench/bench_stream.py

The first two are in real time, from another process through a socket; the hour is on a stepped clock. One
BLAS thread, as the player has it: more of them spin, and keep receiver and renderer from the cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hostile_stream import RATE, HostileHour
from rehearsal import Seen, seen, speaker

from cap4d.bundle import Bundle
from cap4d.drive.live import LiveStream
from cap4d.drive.open_live import open_live
from cap4d.player.avatar import Avatar

pytestmark = pytest.mark.bench
HOUR = float(os.environ.get("CAP4D_STREAM_SECONDS", "3600"))
DISPLAY = 60.0

SENDER = """
import socket, sys, time
import numpy as np
from cap4d.drive.packet import Packet
from cap4d.drive.wire import format_packet
kind, port, rate, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM)
sock.connect(("127.0.0.1", port))
start = time.monotonic()
for i in range(int(rate * seconds)):
    time.sleep(max(start + i / rate - time.monotonic(), 0))
    expr = np.sin(5 * i / rate + np.arange(65)).astype(np.float32)
    sock.sendall(format_packet(Packet(i / rate, "flame2023_no_jaw", expr=expr)))
"""
"""A sender of 65 expressions a frame."""


def watch(stream: LiveStream, avatar: Avatar, seconds: float, size: int) -> list[tuple]:
    """Draws what comes, `DISPLAY` times a second, and returns (now, t, expr) of every picture that played."""
    camera, rows = avatar.camera.resized(size, size), []
    avatar.draw(avatar.bundle.idle.frame(0), camera)
    while stream.state != "playing":
        stream.frame(time.monotonic())
        time.sleep(1e-3)
    start = time.monotonic()
    for i in range(int(seconds * DISPLAY)):
        time.sleep(max(start + i / DISPLAY - time.monotonic(), 0.0))
        frame = stream.frame(time.monotonic())
        avatar.draw(frame, camera, background=(1.0, 1.0, 1.0))
        stream.shown(time.monotonic())
        if stream.state == "playing":
            rows.append((time.monotonic() - start, frame.t, frame.expr))
    return rows


@pytest.fixture(scope="module")
def flame(shared: Path) -> tuple[Bundle, np.ndarray, np.ndarray, Path]:
    return speaker(shared)


@pytest.mark.parametrize("rate", [30.0, 60.0])
@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_age_of_a_picture_on_a_line_without_jitter(flame, kind, rate) -> None:
    bundle, *_ = flame
    with open_live(f"{kind}://127.0.0.1:0", bundle) as stream:
        arguments = [kind, stream.address.rpartition(":")[2], str(rate), "9"]
        sender = subprocess.Popen([sys.executable, "-c", SENDER, *arguments])
        watch(stream, Avatar(bundle), 7, 128)
        found = stream.statistics()
        sender.kill()
        sender.wait()
    print(
        f"\n{kind} at {rate:g} Hz: arrival to drawn {found['latency_ms']}, depth {found['depth_ms']} ms, "
        f"jitter {found['jitter_ms']} ms; {found['late']} late, {found['dropped']} dropped"
    )
    assert found["latency_ms"]["median"] < 1e3 / rate + 30
    assert not found["rejected"] or set(found["rejected"]) == {"late"}


@pytest.mark.parametrize("impair", [None, "loss=5%,jitter=40ms", "loss=5%,jitter=40ms,reorder"])
def test_a_speech_model_through_a_bad_line(flame, shared: Path, impair: str | None) -> None:
    bundle, _, truth, template = flame
    source = next((shared / "flame/codetalker").glob("condition_*.npy"))
    with open_live("tcp://127.0.0.1:0", bundle, template=template) as stream:
        send = [sys.executable, "-m", "cap4d.cli", "drive", str(source), "--to", stream.address, "--loop"]
        sender = subprocess.Popen([*send, *(["--impair", impair] if impair else [])])
        rows = watch(stream, Avatar(bundle), 12, 128)
        found = stream.statistics()
        sender.terminate()
        sender.wait()
    error, worst = Seen.error(seen(rows, found, 0, 0), truth)
    print(
        f"\n{impair or 'a good line'}: arrival to drawn {found['latency_ms']}; {found['received']} received, "
        f"{found['late']} late, {found['dropped']} dropped; {found['interpolated']} of {found['frames']} "
        f"pictures interpolated, {found['held']} held; expressions off by {error:.4f} rms, at worst "
        f"{worst:.2f}, of a spread of {truth.std():.3f}"
    )
    assert error < 0.1 * truth.std() and found["latency_ms"]["median"] < 250


def test_an_hour_of_hostile_senders() -> None:
    resident = {}

    class Measured(HostileHour):
        def _slice(self):
            resident[self.now] = _resident_mb()
            return super()._slice()

    start = time.process_time()
    outcome = Measured().run(HOUR)
    found = outcome.statistics
    print(f"\n{HOUR / 60:g} minutes at {RATE:g} Hz in {time.process_time() - start:.0f} s of CPU; {found}")
    for part, mb in zip(outcome.slices, resident.values(), strict=True):
        print(
            f"  {part.at / 60:5.1f} min: {mb:.2f} MB resident, {part.blocks} blocks; latency "
            f"{1e3 * part.median:.1f} ms, 95 % {1e3 * part.p95:.1f} ms; flowing {100 * part.flowing:.2f} %"
        )
    fates = found["shown"] + found["dropped"] + found["waiting"] + sum(found["rejected"].values())
    assert found["received"] == outcome.sent == fates
    assert set(found["rejected"]) >= set(outcome.expected)
    parts = outcome.slices[1:]
    assert max(part.blocks for part in parts) < 1.003 * parts[0].blocks
    assert max(resident.values()) < list(resident.values())[1] + 1.0
    assert all(part.median < 0.022 and part.flowing > 0.98 for part in parts)


def _resident_mb() -> float:
    """What the process holds now (Linux; 0 elsewhere)."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
