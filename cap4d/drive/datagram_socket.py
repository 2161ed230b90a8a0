"""Datagrams as they come, and how many the system had to drop. What is in them is not known here."""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import threading
from collections.abc import Callable

from cap4d.drive.listener import Listener
from cap4d.drive.packet import Cause, Sink

MAX_DATAGRAM = 1 << 16
RECEIVE_BUFFER = 1 << 20  # bytes the system keeps for us
POLL = 0.1  # s
MAX_REFUSED, BREATH = 64, 10e-3  # refused in a row, after which to let the system drop some; s
SO_RXQ_OVFL = 40 if sys.platform == "linux" else None  # the system tells how many it dropped

Take = Callable[[bytes, tuple, int], int]
"""(a datagram, who sent it, how many things were refused in a row before) -> how many are now."""


class DatagramSocket(Listener):
    """A bound socket of datagrams. Arguments and errors: see `Listener`."""

    def __init__(self, scheme: str, host: str, port: int) -> None:
        super().__init__(scheme, host, port, socket.SOCK_DGRAM)

    def run(self, take: Take, sink: Sink, stop: threading.Event) -> None:
        """Hands over what comes until `stop` is set, and ends within a tenth of a second of it."""
        refused = 0
        with self:
            while not stop.is_set():
                data, sender = self._receive(sink)
                if sender is not None:
                    refused = take(data, sender, refused)
                if refused > MAX_REFUSED:
                    refused = 0
                    stop.wait(BREATH)

    def _bind(self, host: str, port: int) -> socket.socket:
        sock, self._overflowed = super()._bind(host, port), 0
        sock.settimeout(POLL)
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            if SO_RXQ_OVFL is not None:
                sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        return sock

    def _receive(self, sink: Sink) -> tuple[bytes, tuple | None]:
        """A datagram and who sent it; None where none came."""
        try:
            if SO_RXQ_OVFL is None:
                return self.socket.recvfrom(MAX_DATAGRAM)
            data, extra, _, sender = self.socket.recvmsg(MAX_DATAGRAM, socket.CMSG_SPACE(4))
        except OSError:  # time is up; or what we never sent could not be delivered, as Windows says
            return b"", None
        for level, kind, value in extra:
            if (level, kind, len(value)) == (socket.SOL_SOCKET, SO_RXQ_OVFL, 4):
                self._count_overflow(sink, struct.unpack("@I", value)[0])
        return data, sender

    def _count_overflow(self, sink: Sink, total: int) -> None:
        """Datagrams that the system dropped, since the socket was made, modulo 2^32."""
        if lost := (total - self._overflowed) % (1 << 32):
            self._overflowed = total
            sink.rejected(Cause.FLOOD, "more datagrams than the system keeps", times=lost)
