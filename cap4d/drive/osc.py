"""Open Sound Control 1.0: the messages of a datagram.

Written here because what reads a socket has to end: python-osc 1.10 runs for ever on a bundle whose element
has a negative size. Strings end in zeros up to a multiple of 4 bytes; numbers are big-endian; bundles may
nest.
"""

from __future__ import annotations

import struct

from cap4d.drive.packet import Cause, Rejected

BUNDLE = b"#bundle\0"
TIME_TAG = 8  # bytes
MAX_DEPTH = 8  # of bundles in bundles
MAX_MESSAGES = 1024
NUMBERS = {
    "i": struct.Struct(">i"),
    "f": struct.Struct(">f"),
    "h": struct.Struct(">q"),
    "d": struct.Struct(">d"),
}
WORDS = {"T": True, "F": False, "N": None}

Value = int | float | str | bool | None
Message = tuple[str, list[Value]]


def parse_osc(data: bytes) -> list[Message]:
    """(address, values) of each message, in the order of the datagram; time tags are left aside.

    Raises:
        Rejected: SYNTAX, not OSC, or of another type than numbers, text and truths; SIZE, too much of it.
    """
    found: list[Message] = []
    _element(data, found, MAX_DEPTH)
    return found


def _element(data: bytes, found: list[Message], depth: int) -> None:
    if not data.startswith(BUNDLE):
        if len(found) >= MAX_MESSAGES:
            raise Rejected(Cause.SIZE, f"expected at most {MAX_MESSAGES} messages")
        found.append(_message(data))
        return
    if not depth:
        raise Rejected(Cause.SIZE, f"expected bundles at most {MAX_DEPTH} deep")
    at = len(BUNDLE) + TIME_TAG
    if len(data) < at:
        raise Rejected(Cause.SYNTAX, "a bundle is cut short")
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        if not 0 < size <= len(data) - at - 4:
            raise Rejected(Cause.SYNTAX, "an element of a bundle is cut short")
        _element(data[at + 4 : at + 4 + size], found, depth - 1)
        at += 4 + size


def _message(data: bytes) -> Message:
    address, at = _text(data, 0)
    if not address.startswith("/"):
        raise Rejected(Cause.SYNTAX, "expected OSC: a bundle, or an address that begins with /")
    if at == len(data):
        return address, []
    tags, at = _text(data, at)
    if not tags.startswith(","):
        raise Rejected(Cause.SYNTAX, f"{address}: expected type tags after a comma")
    values: list[Value] = []
    for tag in tags[1:]:
        if tag == "s":
            value, at = _text(data, at)
        elif tag in NUMBERS:
            value, at = _number(data, at, NUMBERS[tag])
        elif tag in WORDS:
            value = WORDS[tag]
        else:
            raise Rejected(Cause.SYNTAX, f"{address}: expected numbers, text and truths, got type {tag!r}")
        values.append(value)
    return address, values


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A string, and where what follows it begins."""
    end = data.find(b"\0", at)
    if end < 0:
        raise Rejected(Cause.SYNTAX, "a string has no end")
    following = at + (end - at) // 4 * 4 + 4
    if following > len(data):
        raise Rejected(Cause.SYNTAX, "a string is cut short")
    return data[at:end].decode("utf-8", "replace"), following


def _number(data: bytes, at: int, kind: struct.Struct) -> tuple[int | float, int]:
    if len(data) < at + kind.size:
        raise Rejected(Cause.SYNTAX, "a number is cut short")
    return kind.unpack_from(data, at)[0], at + kind.size
