"""Frames over UDP: a line of JSON a datagram, or several (`wire`); 5,023 vertices are too many for one."""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable

from cap4d.drive.gate import Gate
from cap4d.drive.packet import Cause, Sink
from cap4d.drive.tcp import authority, listen
from cap4d.drive.wire import lines_of

MAX_DATAGRAM = 1 << 16
RECEIVE_BUFFER = 1 << 20  # bytes the system keeps for us
POLL = 0.1  # s
MAX_REFUSED, BREATH = 64, 10e-3  # datagrams refused in a row, after which to let the system drop some; s
SO_RXQ_OVFL = 40 if sys.platform == "linux" else None  # the system tells how many it dropped


class UdpReceiver:
    """A bound socket; see `packet.Receiver`.

    Args:
        host: To listen on.
        port: 0 for any that is free; `address` names it.
        token: What the key `token` of every line has to say; None for no such key.
    Raises:
        ArgumentError: There is no listening there.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        token: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.token, self._clock = token, clock
        self._open(host, port)
        self._bound = self._socket.getsockname()[:2]
        self.address = f"udp://{authority(self._socket)}"

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `packet.Receiver`."""
        gate, refused = Gate(sink, token=self.token), 0
        if self._socket.fileno() < 0:  # a run before this one has closed it
            self._open(*self._bound)
        with self._socket:
            while not stop.is_set():
                data, sender = self._receive(sink)
                refused = self._listen_to(gate, sender, data, refused)
                if refused > MAX_REFUSED:
                    refused = 0
                    stop.wait(BREATH)

    def _open(self, host: str, port: int) -> None:
        self._socket, self._overflowed = listen(host, port, socket.SOCK_DGRAM, "udp"), 0
        self._socket.settimeout(POLL)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            if SO_RXQ_OVFL is not None:
                self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)

    def _listen_to(self, gate: Gate, sender: object, data: bytes, refused: int) -> int:
        """Looks at a datagram's lines up to one too many; how many were refused in a row."""
        lines = lines_of(data)
        for done, line in enumerate(lines, 1):
            refused = refused + 1 if gate.line(sender, line, self._clock()) is None else 0
            if gate.flooded:
                gate.sink.rejected(Cause.FLOOD, times=len(lines) - done)
                break
        return refused

    def _receive(self, sink: Sink) -> tuple[bytes, object]:
        """A datagram and who sent it; an empty one where none came."""
        try:
            if SO_RXQ_OVFL is None:
                return self._socket.recvfrom(MAX_DATAGRAM)
            data, extra, _, sender = self._socket.recvmsg(MAX_DATAGRAM, socket.CMSG_SPACE(4))
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
