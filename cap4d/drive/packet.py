"""A frame as it came from outside, and what every receiver of frames does: the seams of live driving."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np


class Cause(StrEnum):
    """Why a frame was refused; the counts of `--stats` carry these names."""

    SYNTAX = "syntax"  # not a frame of this protocol
    SIZE = "size"  # longer than any frame
    FIELD = "field"  # one is missing, twice there, or of another type
    SHAPE = "shape"  # too many numbers, or too few
    NOT_FINITE = "not_finite"
    RIG = "rig"  # expressions of another rig, with no way between
    TIME = "time"  # no time, or one that makes no sense
    LATE = "late"  # its moment is over
    DUPLICATE = "duplicate"
    FLOOD = "flood"  # more at once than any sender needs
    TOKEN = "token"  # the sender did not give the right one
    SENDER = "sender"  # an address that may not send, or one too many
    RETARGET = "retarget"  # vertices that are no face
    INTERNAL = "internal"  # a fault of ours; the log says which


class Rejected(Exception):
    """A frame that is refused: counted, dropped, never more than that.

    Args:
        cause: What is wrong with it.
        detail: For a log line: what was expected and what was found.
    """

    def __init__(self, cause: Cause, detail: str = "") -> None:
        super().__init__(f"{cause}: {detail}" if detail else str(cause))
        self.cause, self.detail = cause, detail


@dataclass(frozen=True, eq=False)
class Packet:
    """One frame in the sender's own terms: exactly one of `expr`, `arkit` and `vertices` is there.

    Args:
        t: Seconds on the sender's clock.
        rig_name: Whose expressions `expr` are.
        expr: float32[E].
        arkit: float32[52], the order of `arkit.NAMES`.
        vertices: float32[V, 3] m.
        eye_rot, neck_rot, jaw_rot: float32[3] axis-angle, rad; None: the sender has none.
        rot, tra: float32[3] the head's pose in the sender's world, rig axes; None: the sender has none.
    """

    t: float
    rig_name: str | None = None
    expr: np.ndarray | None = None
    arkit: np.ndarray | None = None
    vertices: np.ndarray | None = None
    eye_rot: np.ndarray | None = None
    neck_rot: np.ndarray | None = None
    jaw_rot: np.ndarray | None = None
    rot: np.ndarray | None = None
    tra: np.ndarray | None = None


class Sink(Protocol):
    """Where receivers put what comes. Any thread may call it; it neither blocks nor raises."""

    def packet(self, packet: Packet, arrival: float) -> bool:
        """A sound frame; `arrival` in seconds of `time.monotonic`.

        Returns:
            Whether it was one for this avatar: a sender who sends no such frame does not keep others out.
        """

    def rejected(self, cause: Cause, detail: str = "", *, times: int = 1) -> None:
        """A frame that was refused, or so many."""


class Receiver(Protocol):
    """A source of frames that come by themselves.

    Attributes:
        address: What to show: `tcp://127.0.0.1:9000`.
    """

    address: str

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Receives until `stop` is set, and ends within half a second of it.

        What the other side does (hangs up, sends garbage, floods) never ends it.

        Raises:
            ArgumentError: The address cannot be used; only before the first frame.
        """
