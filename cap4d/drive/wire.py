"""Frames as lines of JSON: what goes over stdin, TCP, UDP and WebSocket, and what of it is believed.

A frame is one object a line, in UTF-8:

    {"t": 12.345, "rig": "flame2023_no_jaw", "expr": [...], "eye_rot": [x, y, z], "neck_rot": [...], ...}
    {"t": 12.345, "arkit": {"jawOpen": 0.4, ...}}             names that are left out are 0
    {"t": 12.345, "vertices": "<base64 of little-endian float32 [V, 3], m>"}

Exactly one of `expr`, `arkit` and `vertices`; `eye_rot`, `neck_rot`, `jaw_rot`, `rot` and `tra` as the sender
has them; other keys are passed over. `{"token": "..."}` says who sends, see `check_token`.
"""

from __future__ import annotations

import binascii
import hmac
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from cap4d.drive.arkit import NAMES
from cap4d.drive.packet import Cause, Packet, Rejected

MAX_LINE = 1 << 20  # bytes; ICT-FaceKit's 26,719 vertices take 427,504
MAX_NUMBERS = 4096  # of an `expr`
MAX_VERTICES = 65_000
MAX_COMMAS, MAX_BRACKETS = 5000, 64  # bounds what parsing a line costs, before it is parsed
MAX_MAGNITUDE = 1e6  # m, rad or expression units; nothing on a face comes near it
MAX_TIME = 1e11  # s; Unix time is below 1e10
MAX_NAME = 256
MAX_BLANK = 2  # lines in a row that are passed over: between frames, and at the end
TURNS = ("eye_rot", "neck_rot", "jaw_rot", "rot", "tra")
KINDS = ("expr", "arkit", "vertices")
COLUMN = {name: i for i, name in enumerate(NAMES)}


def parse_packet(line: bytes) -> Packet:
    """The frame in a line.

    Raises:
        Rejected: It holds none, or not a sound one.
    """
    return packet_of(parse_object(line))


def parse_object(line: bytes) -> dict[str, Any]:
    """The JSON object in a line, with no key twice.

    Raises:
        Rejected: SIZE, SYNTAX or FIELD.
    """
    if len(line) > MAX_LINE or line.count(b",") > MAX_COMMAS:
        raise Rejected(Cause.SIZE, f"expected at most {MAX_LINE} bytes and {MAX_COMMAS} commas")
    if line.count(b"[") + line.count(b"{") > MAX_BRACKETS:
        raise Rejected(Cause.SYNTAX, f"expected at most {MAX_BRACKETS} brackets")
    try:
        value = json.loads(line.decode("utf-8"), object_pairs_hook=_unique, parse_int=_whole)
    except (ValueError, RecursionError) as error:  # a JSONDecodeError, or no UTF-8
        raise Rejected(Cause.SYNTAX, str(error)[:MAX_NAME]) from None
    if not isinstance(value, dict):
        raise Rejected(Cause.SYNTAX, f"expected an object, got {type(value).__name__}")
    return value


def packet_of(value: dict[str, Any]) -> Packet:
    """The frame in an object; see `parse_packet`."""
    given = [kind for kind in KINDS if value.get(kind) is not None]
    if len(given) != 1:
        raise Rejected(Cause.FIELD, f"expected one of {', '.join(KINDS)}, got {', '.join(given) or 'none'}")
    return Packet(
        _time(value.get("t")),
        _rig(value.get("rig")) if given == ["expr"] else None,
        **{given[0]: _READERS[given[0]](value[given[0]])},
        **{name: _vector(name, value[name], 3) for name in TURNS if value.get(name) is not None},
    )


def check_token(value: dict[str, Any], token: str | None) -> None:
    """Refuses what does not bear the token that this side asks for.

    Raises:
        Rejected: TOKEN.
    """
    if not same_token(value.get("token"), token):
        raise Rejected(Cause.TOKEN, "expected the key token with the receiver's token")


def same_token(given: object, token: str | None) -> bool:
    """Whether that is the token, in a time that does not tell how much of it is right."""
    if token is None:
        return True
    given = given if isinstance(given, str) else ""
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode("utf-8", "replace"))


def format_packet(packet: Packet, *, token: str | None = None) -> bytes:
    """The line of a frame, with its newline; float32 come back as the same bits.

    Args:
        token: Written into the line, as UDP needs it.
    """
    value: dict[str, Any] = {"t": packet.t}
    if token is not None:
        value["token"] = token
    if packet.expr is not None:
        value |= {"rig": packet.rig_name, "expr": _shortest(packet.expr)}
    if packet.arkit is not None:
        value["arkit"] = {n: x for n, x in zip(NAMES, _shortest(packet.arkit), strict=True) if x}
    if packet.vertices is not None:
        data = np.ascontiguousarray(packet.vertices, "<f4").tobytes()
        value["vertices"] = binascii.b2a_base64(data, newline=False).decode("ascii")
    for name in TURNS:
        if (turn := getattr(packet, name)) is not None:
            value[name] = _shortest(turn)
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def format_token(token: str) -> bytes:
    """The first line of a connection to a receiver that asks for a token."""
    return json.dumps({"token": token}).encode() + b"\n"


def lines_of(message: bytes) -> list[bytes]:
    """The lines of a datagram or message, those that are blank within it too; none where all are."""
    message = message.strip()
    return message.split(b"\n") if message else []


class LineSplitter:
    """Bytes as they come -> lines, in bounded memory.

    Args:
        limit: Bytes of a line; a longer one is passed over up to its end.
    """

    def __init__(self, limit: int = MAX_LINE) -> None:
        self.limit = limit
        self._held = bytearray()
        self._searched = 0  # of `_held`, no newline in it
        self._skipping = False
        self._blank = 0  # lines in a row

    def feed(self, data: bytes) -> Iterator[bytes | None]:
        """The lines that `data` completes; None for each that is too long.

        Blank ones are left out, but for those of more than `MAX_BLANK` in a row: these cost the sender as
        any line does.
        """
        self._held += data
        start = 0
        while (end := self._held.find(b"\n", max(start, self._searched))) >= 0:
            line, start = bytes(self._held[start : min(end, start + self.limit + 1)]), end + 1
            self._searched = 0
            self._blank = 0 if line.strip() else self._blank + 1
            if self._skipping:  # its end; it was told of
                self._skipping = False
            elif len(line) > self.limit:
                yield None
            elif not 0 < self._blank <= MAX_BLANK:
                yield line
        del self._held[:start]
        self._searched = len(self._held)
        if len(self._held) > self.limit:
            too_long, self._skipping = not self._skipping, True
            self._drop()
            if too_long:
                yield None
        elif self._skipping:
            self._drop()

    def _drop(self) -> None:
        self._held.clear()
        self._searched = 0


def _time(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, float | int):
        raise Rejected(Cause.TIME, f"t: expected seconds, got {type(value).__name__}")
    if not abs(value) <= MAX_TIME:
        raise Rejected(Cause.TIME, f"t: expected at most {MAX_TIME:g} s, got {value:g}")
    return float(value)


def _rig(value: object) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= MAX_NAME:
        raise Rejected(Cause.FIELD, "rig: expected the name of the rig whose expressions these are")
    return value


def _vector(name: str, value: object, size: int | None) -> np.ndarray:
    """float32[size] from a list of numbers."""
    if not isinstance(value, list) or not all(type(x) in (float, int) for x in value):
        raise Rejected(Cause.FIELD, f"{name}: expected a list of numbers")
    if (size is not None and len(value) != size) or not 1 <= len(value) <= MAX_NUMBERS:
        raise Rejected(Cause.SHAPE, f"{name}: expected {size or 'some'} numbers, got {len(value)}")
    return _finite(name, np.array(value, np.float64))


def _expr(value: object) -> np.ndarray:
    return _vector("expr", value, None)


def _arkit(value: object) -> np.ndarray:
    if not isinstance(value, dict):
        raise Rejected(Cause.FIELD, "arkit: expected an object of names and weights")
    if unknown := next((name for name in value if name not in COLUMN), None):
        raise Rejected(Cause.FIELD, f"arkit: expected Apple's names, got {unknown[:MAX_NAME]!r}")
    arkit = np.zeros(len(NAMES), np.float32)
    if value:
        arkit[[COLUMN[name] for name in value]] = _vector("arkit", list(value.values()), len(value))
    return arkit


def _vertices(value: object) -> np.ndarray:
    if not isinstance(value, str):
        raise Rejected(Cause.FIELD, f"vertices: expected base64, got {type(value).__name__}")
    try:
        data = binascii.a2b_base64(value, strict_mode=True)
    except (ValueError, binascii.Error) as error:
        raise Rejected(Cause.FIELD, f"vertices: {error}") from None
    count, rest = divmod(len(data), 12)
    if rest or not 1 <= count <= MAX_VERTICES:
        raise Rejected(Cause.SHAPE, f"vertices: expected 12 bytes for each of up to {MAX_VERTICES}")
    return _finite("vertices", np.frombuffer(data, "<f4").reshape(count, 3))


def _finite(name: str, value: np.ndarray) -> np.ndarray:
    """As float32 of its own."""
    if not np.abs(value).max() <= MAX_MAGNITUDE:  # one that is not a number compares false
        raise Rejected(Cause.NOT_FINITE, f"{name}: expected numbers of at most {MAX_MAGNITUDE:g}")
    return value.astype(np.float32)


_READERS = {"expr": _expr, "arkit": _arkit, "vertices": _vertices}


def _whole(digits: str) -> float:
    """Whole numbers are read as the others are: a thousand digits are infinity, not work."""
    return float(digits)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        raise Rejected(Cause.FIELD, "expected every key once")
    return value


def _shortest(values: np.ndarray) -> list[float]:
    """The fewest digits that give the same float32."""
    return [float(str(x)) for x in np.asarray(values, np.float32).ravel()]
