"""What stands between senders and the sink: one sender rules, and none may flood."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

from cap4d.drive.packet import Cause, Rejected, Sink
from cap4d.drive.wire import check_token, packet_of, parse_object

MAX_RATE, BURST = 300.0, 150.0  # frames a second of a sender, and at once
MAX_BYTES, BYTES_BURST = 32e6, 8e6  # ICT-FaceKit's vertices at 60 Hz are 26e6 a second
ALL = 2.0  # times that for all senders together
SILENCE = 1.0  # s after which a sender who rules no longer does
MAX_SENDERS = 64  # whose budgets are remembered


class Gate:
    """Decides about each line. Not for two threads at once.

    The first sender of a frame that is taken rules, until it leaves or is silent for a second; lines of
    others are refused unread. So is what is more than `MAX_RATE` and `MAX_BYTES`, which bounds the work.

    Args:
        sink: Gets the frames, and the causes of what is refused.
        token: Asked for in every line, or None.
    Attributes:
        flooded: Whether the last line was refused as one too many.
    """

    def __init__(self, sink: Sink, *, token: str | None = None) -> None:
        self.sink, self.token, self.flooded = sink, token, False
        self._ruler: Hashable | None = None
        self._heard = float("-inf")
        self._budgets: OrderedDict[Hashable, Budget] = OrderedDict()
        self._budget = Budget(ALL)

    def line(self, sender: Hashable, line: bytes | None, arrival: float) -> float | None:
        """A line (None: one that was too long to keep) that arrived at `arrival` s.

        Returns:
            The stamp of its frame, s, if it was taken.
        """
        try:
            self._admit(sender, line, arrival)
            value = parse_object(line)
            check_token(value, self.token)
            packet = packet_of(value)
        except Rejected as error:
            self.flooded = error.cause == Cause.FLOOD
            self.sink.rejected(error.cause, error.detail)
            return None
        self.flooded = False
        if not self.sink.packet(packet, arrival):
            return None
        self._ruler, self._heard = sender, arrival
        return packet.t

    def rules(self, sender: Hashable, now: float) -> bool:
        """Whether the sender may send: it rules, or none does."""
        return self._ruler in (None, sender) or now - self._heard > SILENCE

    def leave(self, sender: Hashable) -> None:
        """A sender hung up."""
        self._budgets.pop(sender, None)
        if self._ruler == sender:
            self._ruler = None

    def _admit(self, sender: Hashable, line: bytes | None, now: float) -> None:
        if not self.rules(sender, now):
            raise Rejected(Cause.SENDER, "another one sends already")
        if line is None:
            raise Rejected(Cause.SIZE, "a line is longer than any frame")
        if not (self._budget_of(sender).take(len(line), now) and self._budget.take(len(line), now)):
            raise Rejected(
                Cause.FLOOD, f"expected at most {MAX_RATE:g} frames and {MAX_BYTES:g} bytes a second"
            )

    def _budget_of(self, sender: Hashable) -> Budget:
        budget = self._budgets.setdefault(sender, Budget())
        self._budgets.move_to_end(sender)
        if len(self._budgets) > MAX_SENDERS:
            self._budgets.popitem(last=False)
        return budget


class Budget:
    """Two token buckets, of frames and of bytes, each full at first.

    Args:
        times: The limits of so many senders.
        rate: Frames a second of a sender.
    """

    def __init__(self, times: float = 1.0, *, rate: float = MAX_RATE) -> None:
        self._times, self._rate, self._burst = times, times * rate, times * rate * BURST / MAX_RATE
        self._frames, self._bytes = self._burst, times * BYTES_BURST
        self._now = float("-inf")

    def take(self, size: int, now: float) -> bool:
        """Whether a line of `size` bytes may pass at `now` s."""
        elapsed = min(max(now - self._now, 0.0), 1.0)
        self._now = max(self._now, now)
        self._frames = min(self._frames + self._rate * elapsed, self._burst)
        self._bytes = min(self._bytes + self._times * MAX_BYTES * elapsed, self._times * BYTES_BURST)
        passes = self._frames >= 1 and self._bytes >= size
        if passes:
            self._frames, self._bytes = self._frames - 1, self._bytes - size
        return passes
