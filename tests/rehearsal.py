"""A speech model's vertices through a bad line to a viewer without a window: what of it is seen, and when."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from stepped_clock import SteppedClock

from cap4d.bundle import Bundle
from cap4d.drive.convert import Converter
from cap4d.drive.impair import BadLine, Impairment
from cap4d.drive.live import LiveStream
from cap4d.drive.packet import Packet
from cap4d.drive.tcp import TcpReceiver
from cap4d.drive.wire import format_packet
from cap4d.player.avatar import Avatar

SOURCE_FPS = 30.0
PATIENCE = 20.0  # real s until a test gives up


@dataclass(frozen=True)
class Seen:
    """What was on screen, N pictures.

    Args:
        now: float64[N] s on the wall clock since the sender began.
        t: float64[N] s of the stream.
        expr: float32[N, E].
        statistics: Of the stream, at its end.
        sent: Frames that set off.
        lost: Of these, how many the line lost.
    """

    now: np.ndarray
    t: np.ndarray
    expr: np.ndarray
    statistics: dict[str, Any]
    sent: int
    lost: int

    def error(self, truth: np.ndarray) -> tuple[float, float]:
        """Root mean square and largest difference of expressions from float32[T, E], the clip that repeats.

        Of each picture from the moment of the stream that it shows; without the first second, which fades in.
        """
        difference = (self.expr - between(truth, self.t * SOURCE_FPS))[self.now > 1]
        return float(np.sqrt((difference**2).mean())), float(np.abs(difference).max())

    def delay(self, truth: np.ndarray) -> tuple[float, float]:
        """s by which the strongest motion on screen lags the sender's clock, and their correlation then."""
        _, _, axes = np.linalg.svd(truth - truth.mean(0), full_matrices=False)
        kept = self.now > 1
        seen = self.expr[kept] @ axes[0]
        delays = np.arange(0, 0.4, 1e-3)
        likeness = [
            np.corrcoef(seen, between(truth, (self.now[kept] - d) * SOURCE_FPS) @ axes[0])[0, 1]
            for d in delays
        ]
        return float(delays[int(np.argmax(likeness))]), float(np.max(likeness))


def between(clip: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The clip [T, E], which repeats, at fractional frames [N]."""
    at = np.floor(position).astype(int)
    blend = (position - at)[:, None]
    return (1 - blend) * clip[at % len(clip)] + blend * clip[(at + 1) % len(clip)]


def rehearse(
    bundle: Bundle,
    vertices: np.ndarray,
    template: Path,
    impairment: Impairment,
    *,
    seconds: float,
    display: float = 60.0,
    size: int = 64,
) -> Seen:
    """Sends vertices [T, V, 3] through a socket, again and again, and draws what arrives.

    Everything happens one after the other on a stepped clock: the numbers are the same on any machine. What
    a real one adds is the time it takes to draw.
    """
    clock, avatar = SteppedClock(1000.0), Avatar(bundle)
    receiver = TcpReceiver("127.0.0.1", 0, clock=clock)
    stream = LiveStream(receiver, Converter(bundle, template=template), clock=clock)
    line, sent, rows, start = BadLine(impairment, frame_time=1 / SOURCE_FPS), 0, [], clock.now
    with stream, socket.create_connection(_endpoint(stream.address)) as sock:
        for i in range(int(seconds * display)):
            tick = start + (i + 0.4) / display
            while (at := min(line.due(), start + sent / SOURCE_FPS)) < tick:
                clock.now = at
                if at < line.due():
                    line.put(_message(vertices, sent), at)
                    sent += 1
                for message in line.take(at):
                    _deliver(message, sock, stream)
            clock.now = tick
            frame = stream.frame(tick)
            avatar.draw(frame, bundle.camera.resized(size, size), background=(1.0, 1.0, 1.0))
            stream.shown(tick)
            if stream.state == "playing":
                rows.append((tick - start, frame.t, frame.expr))
        statistics = stream.statistics()
    return seen(rows, statistics, sent, line.counts["lost"])


def seen(rows: list[tuple[float, float, np.ndarray]], statistics: dict, sent: int, lost: int) -> Seen:
    """From (now, t, expr) of each picture."""
    now, t, expr = (np.array(column) for column in zip(*rows, strict=True))
    return Seen(now, t, expr, statistics, sent, lost)


def _message(vertices: np.ndarray, number: int) -> bytes:
    return format_packet(Packet(number / SOURCE_FPS, vertices=vertices[number % len(vertices)]))


def _deliver(message: bytes, sock: socket.socket, stream: LiveStream) -> None:
    """Sends it, and waits until it is there."""
    before, end = stream.statistics()["received"], time.monotonic() + PATIENCE
    sock.sendall(message)
    while stream.statistics()["received"] == before:
        assert time.monotonic() < end, "the message did not arrive"
        time.sleep(2e-4)


def speaker(shared: Path) -> tuple[Bundle, np.ndarray, np.ndarray, Path]:
    """FLAME's stand-in, drawable; vertices [T, 5023, 3]; the expressions behind them; the template's file."""
    from drive_bundle import on_rig

    from cap4d.rig.flame import import_flame

    folder = shared / "flame"
    bundle = on_rig(import_flame(folder / "flame_standin.pkl", folder / "cap4d_assets"))
    bundle = replace(bundle, deform_neutral=np.zeros((len(bundle.grid), 3), np.float32))
    vertices = np.load(next((folder / "codetalker").glob("condition_*.npy")))
    template = folder / "codetalker/truth.npz"
    return bundle, np.float32(vertices).reshape(-1, 5023, 3), np.load(template)["expr"], template


def _endpoint(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    return parts.hostname, parts.port
