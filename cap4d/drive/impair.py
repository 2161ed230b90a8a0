"""A bad line between a sender and a viewer, on purpose: frames lost, late, overtaken, doubled, and garbage.

Pure: callers pass the time. What happens to the n-th message depends on the seed and n alone: a run can be
repeated, and a run with one more impairment still loses the same frames.
"""

from __future__ import annotations

import heapq
import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cap4d.errors import ArgumentError

MAX_JITTER = 4.0  # standard deviations: the latest that a frame is
MAX_DELAY = 10.0  # s of jitter that can be asked for
DEFAULT_REORDER = 0.05  # of a bare `reorder`
HELD_FRAMES = 3  # the most frames that one is held back for
NOISE_BYTES = 200  # the longest noise

EXAMPLE = "loss=5%,jitter=40ms,reorder,duplicate=1%,garbage=1%"

Garbage = Callable[[np.random.Generator, bytes], bytes]
"""(random numbers, the message it goes before) -> a message that is no frame."""


@dataclass(frozen=True)
class Impairment:
    """How bad a line is. Shares are of the messages, in [0, 1].

    Args:
        loss: Never arrive.
        jitter: s. A message is late by |x|, x normal with this standard deviation: half of them by less than
            0.67, one in twenty by more than 1.96, none by more than 4 times it.
        reorder: Are held back by one to three frames besides. Above 0 messages overtake one another; at 0 a
            late one holds up those behind it, as in a queue.
        duplicate: Arrive twice, each copy late by itself.
        garbage: Have a message before them that is no frame.
    """

    loss: float = 0.0
    jitter: float = 0.0
    reorder: float = 0.0
    duplicate: float = 0.0
    garbage: float = 0.0


def parse_impairment(text: str) -> Impairment:
    """Any of `loss=5%,jitter=40ms,reorder,duplicate=1%,garbage=1%`; shares as 5% or 0.05, times as ms or s.

    Raises:
        ArgumentError: Anything else.
    """
    values: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if name in values or name not in Impairment.__dataclass_fields__:
            raise ArgumentError(f"impair: expected some of {EXAMPLE}, got {part.strip()!r}")
        if name == "reorder" and not equals:
            values[name] = DEFAULT_REORDER
        else:
            values[name] = _seconds(part, value) if name == "jitter" else _share(part, value)
    return Impairment(**values)


def _share(part: str, value: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)(%?)", value)
    share = float(match[1]) / (100 if match[2] else 1) if match else math.inf
    if share > 1:
        raise ArgumentError(f"impair: expected a share such as 5% or 0.05, got {part.strip()!r}")
    return share


def _seconds(part: str, value: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)(ms|s)", value)
    seconds = float(match[1]) / (1000 if match[2] == "ms" else 1) if match else math.inf
    if seconds > MAX_DELAY:
        raise ArgumentError(
            f"impair: expected a time such as 40ms, up to {MAX_DELAY:g}s, got {part.strip()!r}"
        )
    return seconds


class BadLine:
    """Messages on their way.

    Args:
        impairment: What happens to them.
        seed: Of everything that is drawn.
        frame_time: s between frames; what is held back is so by this.
        garbage: What garbage of this protocol looks like.
    Attributes:
        counts: `lost`, `late` (by jitter, at least a millisecond), `held`, `doubled`, `garbage`.
    """

    def __init__(
        self,
        impairment: Impairment,
        *,
        seed: int = 0,
        frame_time: float = 1 / 30,
        garbage: Garbage | None = None,
    ) -> None:
        self.impairment, self.seed, self.frame_time = impairment, seed, frame_time
        self.counts: Counter[str] = Counter()
        self._garbage = garbage or noise
        self._heap: list[tuple[float, int, bytes]] = []  # (leaves at, number, message)
        self._messages = self._numbers = 0
        self._last = -math.inf  # the latest departure of a line on which nothing overtakes

    def put(self, message: bytes, at: float) -> None:
        """A message sets off at `at` seconds; what becomes of it is settled here."""
        rng = np.random.default_rng((self.seed, self._messages))
        self._messages += 1
        lost, held, doubled, garbled = rng.random(4) < self._shares()
        delays, frames = np.abs(rng.standard_normal(2)), int(rng.integers(1, HELD_FRAMES + 1))
        if garbled:
            self._leave("garbage", self._garbage(rng, message), at)
        if lost:
            self.counts["lost"] += 1
            return
        for copy in range(1 + doubled):
            late = self.impairment.jitter * min(float(delays[copy]), MAX_JITTER)
            self.counts["late"] += late >= 1e-3
            self._leave("doubled" if copy else "", message, at + late, held=held * frames * self.frame_time)
        self.counts["held"] += bool(held)

    def due(self) -> float:
        """When the next message arrives; infinity: none is on its way."""
        return self._heap[0][0] if self._heap else math.inf

    def take(self, now: float) -> list[bytes]:
        """What has arrived by `now`, in the order of its arrival."""
        arrived = []
        while self._heap and self._heap[0][0] <= now:
            arrived.append(heapq.heappop(self._heap)[2])
        return arrived

    def _shares(self) -> np.ndarray:
        wanted = self.impairment
        return np.array([wanted.loss, wanted.reorder, wanted.duplicate, wanted.garbage])

    def _leave(self, count: str, message: bytes, at: float, held: float = 0.0) -> None:
        if self.impairment.reorder == 0:
            at = self._last = max(at, self._last)
        heapq.heappush(self._heap, (at + held, self._numbers, message))
        self._numbers += 1
        if count:
            self.counts[count] += 1


def noise(rng: np.random.Generator, message: bytes) -> bytes:
    """Garbage of any protocol: random bytes, or a message cut short."""
    if rng.random() < 0.5 and len(message) > 1:
        return message[: int(rng.integers(1, len(message)))]
    return rng.bytes(int(rng.integers(1, NOISE_BYTES)))


NO_FRAMES = (b"", b"null", b"[]", b'"t"', b'{"t": NaN}', b'{"t": 1e999, "expr": []}', b'{"rig": "none"}')


def line_noise(rng: np.random.Generator, message: bytes) -> bytes:
    """Garbage of a protocol of lines: noise, or JSON that is no frame; one line."""
    choice = int(rng.integers(0, 2 * len(NO_FRAMES)))
    body = NO_FRAMES[choice] if choice < len(NO_FRAMES) else noise(rng, message.rstrip())
    return body.replace(b"\n", b" ").replace(b"\r", b" ") + b"\n"
