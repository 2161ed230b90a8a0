"""What a page may say: one small JSON object a message, believed key by key."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any

MAX_MESSAGE = 4096  # bytes
MAX_NUMBER = 1e4
MAX_PICTURE = 16384  # px a side; what is drawn is bounded by --size
MAX_NAMES = 64  # expressions in one message
MAX_ACK = 1 << 53  # whole numbers that JavaScript knows

Pair = tuple[float, float]


class BadMessageError(Exception):
    """Nothing that the page would send."""


@dataclass(frozen=True)
class Message:
    """What was said; None or empty: nothing about that.

    Args:
        ack: Number of the picture that is on screen.
        size: (width, height) px of the page's picture.
        background: sRGB in [0, 1] behind the avatar.
        turn, pan: A drag (right, down), in heights (turn) or shorter sides (pan) of the picture.
        zoom: Steps of the wheel, nearer is positive.
        home: Back to the first view.
        play: On, or paused.
        seek: s from the clip's start.
        expr: Values to hold expressions at; None lets one go.
        reset: Lets all expressions go.
    """

    ack: int | None = None
    size: tuple[int, int] | None = None
    background: tuple[float, float, float] | None = None
    turn: Pair | None = None
    pan: Pair | None = None
    zoom: float | None = None
    home: bool = False
    play: bool | None = None
    seek: float | None = None
    expr: dict[str, float | None] = field(default_factory=dict)
    reset: bool = False


def parse_message(data: str | bytes) -> Message:
    """Raises BadMessageError for anything but a sound message."""
    if not isinstance(data, str) or len(data) > MAX_MESSAGE:
        raise BadMessageError("expected a short text")
    try:
        value = json.loads(data, parse_int=float)
    except (ValueError, RecursionError) as error:
        raise BadMessageError("expected JSON") from error
    if not isinstance(value, dict) or not value.keys() <= _READERS.keys():
        raise BadMessageError(f"expected an object with some of {', '.join(_READERS)}")
    return Message(**{name: _READERS[name](part) for name, part in value.items()})


def _number(value: Any, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> float:
    if not isinstance(value, float) or not low <= value <= high:  # a NaN is not
        raise BadMessageError(f"expected a number of {low:g} to {high:g}")
    return value


def _numbers(value: Any, count: int, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise BadMessageError(f"expected {count} numbers")
    return tuple(_number(part, low, high) for part in value)


def _bool(value: Any) -> bool:
    if not isinstance(value, bool):
        raise BadMessageError("expected true or false")
    return value


def _ack(value: Any) -> int:
    return math.floor(_number(value, 0, MAX_ACK))


def _size(value: Any) -> tuple[int, int]:
    width, height = _numbers(value, 2, 1, MAX_PICTURE)
    return math.floor(width), math.floor(height)


def _expr(value: Any) -> dict[str, float | None]:
    if not isinstance(value, dict) or len(value) > MAX_NAMES:
        raise BadMessageError("expected an object of expressions")
    return {name: None if part is None else _number(part, -100, 100) for name, part in value.items()}


_READERS = {
    "ack": _ack,
    "size": _size,
    "background": lambda value: _numbers(value, 3, 0, 1),
    "turn": lambda value: _numbers(value, 2),
    "pan": lambda value: _numbers(value, 2),
    "zoom": lambda value: _number(value, -100, 100),
    "home": _bool,
    "play": _bool,
    "seek": lambda value: _number(value, 0),
    "expr": _expr,
    "reset": _bool,
}
