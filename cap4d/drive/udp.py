"""Frames over UDP: a line of JSON a datagram, or several (`wire`); 5,023 vertices are too many for one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from cap4d.drive.datagram_socket import DatagramSocket
from cap4d.drive.gate import Gate
from cap4d.drive.packet import Cause, Sink
from cap4d.drive.wire import lines_of


class UdpReceiver:
    """A bound socket; see `packet.Receiver`.

    Args:
        host, port: See `Listener`.
        token: What the key `token` of every line has to say; None for no such key.
    Raises:
        ArgumentError: There is no listening there.
    """

    def __init__(
        self, host: str, port: int, *, token: str | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.token, self._clock = token, clock
        self._socket = DatagramSocket("udp", host, port)
        self.address = self._socket.address

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `packet.Receiver`."""
        gate = Gate(sink, token=self.token)
        self._socket.run(lambda *datagram: self._listen_to(gate, *datagram), sink, stop)

    def _listen_to(self, gate: Gate, data: bytes, sender: tuple, refused: int) -> int:
        """Looks at a datagram's lines up to one too many; how many were refused in a row."""
        lines = lines_of(data)
        for done, line in enumerate(lines, 1):
            refused = refused + 1 if gate.line(sender, line, self._clock()) is None else 0
            if gate.flooded:
                gate.sink.rejected(Cause.FLOOD, times=len(lines) - done)
                break
        return refused
