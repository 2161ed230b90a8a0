"""Holds back a sender who runs ahead of its own stamps: a file poured into a pipe plays at its own speed.

A live sender is never held back: what it has sent and nobody has read yet is a moment's hiccup, not half a
second.
"""

from __future__ import annotations

import struct

POURED = 0.5  # s of stream that wait to be read: more than a live sender leaves
FASTER = 1.005  # than the stamps, so that a live sender who was taken for a file catches up
MAX_STEP = 0.25  # s between two stamps that may be waited for; a longer one is a cut
PAUSE = 2.0  # s without a frame; what comes after less was held up, and catches up at once
LEAST = 5e-3  # s worth waiting
PIPE = 60_000  # bytes: a pipe that holds so many is full


class Pace:
    """How far a sender is ahead of its stamps."""

    def __init__(self) -> None:
        self._lead, self._poured = 0.0, False
        self._last: tuple[float, float] | None = None

    def lead(self, t: float, now: float, *, size: int, waiting: float) -> float:
        """s to wait before the next frame; 0 for none.

        Args:
            t: Stamp of this one, s.
            now: When it came, s.
            size: Bytes of its line.
            waiting: Bytes behind it that nobody has looked at.
        """
        if self._last is not None:
            stamps, elapsed = min(max(t - self._last[0], 0.0), MAX_STEP), max(now - self._last[1], 0.0)
            lead = self._lead if elapsed < PAUSE else FASTER * elapsed
            self._lead = max(lead + stamps - FASTER * elapsed, -PAUSE)
            self._poured = waiting > 0 and (self._poured or waiting * stamps > POURED * size)
        self._last = t, now
        return self._lead if self._poured and self._lead > LEAST else 0.0


def unread(file: int) -> int:
    """Bytes that wait in a pipe or socket; 0 where the system does not say."""
    try:
        import fcntl
        import termios

        return struct.unpack("@i", fcntl.ioctl(file, termios.FIONREAD, bytes(4)))[0]
    except (ImportError, OSError, ValueError):  # ValueError: it is closed, and its number -1
        return 0
