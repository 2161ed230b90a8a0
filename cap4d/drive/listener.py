"""Where a receiver listens: a bound socket, which can be opened again at the same address."""

from __future__ import annotations

import os
import socket

from cap4d.errors import ArgumentError

MAX_CONNECTIONS = 8


class Listener:
    """Bound from the start, so that `address` is known; as a context it is opened again if it was closed.

    Args:
        scheme: Of `address`.
        host: To listen on.
        port: 0 for any that is free; `address` names it.
        kind: SOCK_STREAM, which then waits for connections, or SOCK_DGRAM.
    Raises:
        ArgumentError: There is no listening there.
    """

    def __init__(self, scheme: str, host: str, port: int, kind: socket.SocketKind) -> None:
        self._scheme, self._kind = scheme, kind
        self.socket = self._bind(host, port)
        self._bound = self.socket.getsockname()[:2]
        self.address = f"{scheme}://{_authority(*self._bound)}"

    def __enter__(self) -> socket.socket:
        if self.socket.fileno() < 0:
            self.socket = self._bind(*self._bound)
        return self.socket

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Until the next `with`."""
        self.socket.close()

    def _bind(self, host: str, port: int) -> socket.socket:
        kind = self._kind
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=kind, flags=socket.AI_PASSIVE)[0]
            sock = socket.socket(family, kind)
            try:
                if kind == socket.SOCK_STREAM and os.name == "posix":  # for a player started again
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                sock.bind(address)
                if kind == socket.SOCK_STREAM:
                    sock.listen(MAX_CONNECTIONS)
            except OSError:
                sock.close()
                raise
            return sock
        except (OSError, UnicodeError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            where = f"{self._scheme}://{host}:{port}"
            raise ArgumentError(f"drive: expected to listen at {where}, got: {reason}") from error


def _authority(host: str, port: int) -> str:
    """`127.0.0.1:9000`"""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
