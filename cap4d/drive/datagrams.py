"""Datagrams of programs that speak protocols of their own: one sender rules, and none may flood."""

from __future__ import annotations

import ipaddress
import socket
import threading
import time
from collections.abc import Callable
from typing import Protocol

from cap4d.drive.datagram_socket import DatagramSocket
from cap4d.drive.gate import MAX_RATE, SILENCE, Budget
from cap4d.drive.packet import Cause, Packet, Rejected, Sink
from cap4d.errors import ArgumentError


class Parser(Protocol):
    """What one sender's datagrams mean; it may remember earlier ones."""

    def __call__(self, data: bytes, arrival: float) -> list[Packet]:
        """The frames that are complete with this datagram, which may be none.

        Raises:
            Rejected: It is none of this protocol.
        """


class DatagramReceiver:
    """A bound socket; see `packet.Receiver`.

    The first sender of a frame that is taken rules, until it is silent for a second.

    Args:
        scheme, host, port: See `Listener`.
        sender: The only address that may send, by number or by name; None: whoever reaches us.
        parser: Makes a sender's parser.
        rate: Datagrams a second that the protocol may need; their bytes are limited all the same.
    Raises:
        ArgumentError: There is no listening there, or no such sender.
    """

    def __init__(
        self,
        scheme: str,
        host: str,
        port: int,
        *,
        sender: str | None,
        parser: Callable[[], Parser],
        rate: float = MAX_RATE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._allowed = None if sender is None else _addresses(sender)
        self._new_parser, self._clock = parser, clock
        self._socket = DatagramSocket(scheme, host, port)
        self.address = self._socket.address
        self._parser, self._ruler, self._heard = parser(), None, float("-inf")
        self._budget = Budget(rate=rate)

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """See `packet.Receiver`."""

        def take(data: bytes, sender: tuple, refused: int) -> int:
            return 0 if self.datagram(data, sender, sink) else refused + 1

        self._socket.run(take, sink, stop)

    def datagram(self, data: bytes, sender: tuple, sink: Sink) -> bool:
        """Takes one in, or counts why not; True: it was of the protocol and of who may send."""
        now = self._clock()
        try:
            self._admit(sender, len(data), now)
            packets = self._parser(data, now)
        except Rejected as error:
            sink.rejected(error.cause, error.detail)
            return False
        if any([sink.packet(packet, now) for packet in packets]):
            self._ruler, self._heard = sender[:2], now
        return True

    def _admit(self, sender: tuple, size: int, now: float) -> None:
        if self._allowed is not None and _number(sender[0]) not in self._allowed:
            raise Rejected(Cause.SENDER, "of an address that may not send")
        is_another = self._ruler not in (None, sender[:2])
        if is_another and now - self._heard <= SILENCE:  # not at the cost of who rules
            raise Rejected(Cause.SENDER, "another one sends already")
        if not self._budget.take(size, now):
            raise Rejected(Cause.FLOOD, "more datagrams than any sender needs")
        if is_another:
            self._ruler, self._parser = None, self._new_parser()


def _addresses(sender: str) -> set[str]:
    """The numbers of an address or a name."""
    try:
        return {_number(info[4][0]) for info in socket.getaddrinfo(sender, None)}
    except (OSError, UnicodeError) as error:
        raise ArgumentError(f"drive: expected from=ADDRESS of a sender, got {sender}: {error}") from error


def _number(host: str) -> str:
    """The address in one spelling; one of IPv4 that came through IPv6 is one of IPv4."""
    address = ipaddress.ip_address(host.partition("%")[0])
    mapped = getattr(address, "ipv4_mapped", None)
    return str(mapped or address)
