"""A receiver in its thread, what it heard, and what is said to it over loopback."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np

from cap4d.drive.packet import Packet, Receiver
from cap4d.drive.wire import format_packet

PATIENCE = 10.0  # s until a test gives up


class Kept:
    """A sink that keeps everything; frames of another rig than `tiny` are not its own."""

    def __init__(self) -> None:
        self.packets: list[Packet] = []
        self.arrivals: list[float] = []
        self.causes: Counter[str] = Counter()
        self.refusals = 0  # calls of `rejected`

    def packet(self, packet: Packet, arrival: float) -> bool:
        if packet.rig_name != "tiny":
            self.causes["rig"] += 1
            return False
        self.packets.append(packet)
        self.arrivals.append(arrival)
        return True

    def rejected(self, cause, detail="", *, times=1) -> None:
        self.causes[str(cause)] += times
        self.refusals += 1

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, (len(self.packets), self.causes)
            time.sleep(0.002)

    def stamps(self) -> list[float]:
        return [packet.t for packet in self.packets]


@contextmanager
def running(receiver: Receiver) -> Iterator[Kept]:
    """The receiver in its thread, which ends within half a second of being told."""
    sink, stop, failed = Kept(), threading.Event(), []

    def run() -> None:
        try:
            receiver.run(sink, stop)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield sink
    finally:
        stop.set()
        start = time.monotonic()
        thread.join(PATIENCE)
    assert not failed and not thread.is_alive()
    assert time.monotonic() - start < 1.0  # half a second on a machine that does nothing else


def line(t: float, *, rig: str = "tiny", token: str | None = None) -> bytes:
    return format_packet(Packet(t, rig, expr=np.float32([t])), token=token)


def port_of(receiver: Receiver) -> int:
    return urlsplit(receiver.address).port


def connect(receiver: Receiver) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port_of(receiver)), timeout=PATIENCE)


def closed(sock: socket.socket) -> str:
    """What the other side said before it hung up."""
    said = b""
    try:
        while data := sock.recv(1000):
            said += data
    except ConnectionResetError:
        pass
    return said.decode()


@contextmanager
def datagrams(receiver: Receiver) -> Iterator[Callable[[bytes], None]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        yield lambda data: sock.sendto(data, ("127.0.0.1", port_of(receiver)))


def until_heard(sink: Kept, send: Callable[[], None], heard: Callable[[], object]) -> None:
    """Sends until it is: what comes before the socket is open again is lost."""

    def is_heard() -> bool:
        send()
        return bool(heard())

    sink.until(is_heard)
