"""Limits as people write them: `45dB`, `20MB`."""

from __future__ import annotations

import re

from cap4d.errors import ArgumentError

UNITS = {"": 1, "b": 1, "kb": 1e3, "mb": 1e6, "gb": 1e9, "kib": 1 << 10, "mib": 1 << 20, "gib": 1 << 30}
MOST_DB = 100.0  # about where float32 itself is


def parse_decibels(text: str) -> float:
    """`45dB` or `45` -> 45.0

    Raises:
        ArgumentError: Not a number of decibels, or beyond what pictures in float32 can keep.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(?:dB)?\s*", text, re.IGNORECASE)
    if match is None or not 0 < float(match[1]) <= MOST_DB:
        raise ArgumentError(
            f"max-error: expected more than 0 and at most {MOST_DB:g} dB, e.g. 45dB, got {text}"
        )
    return float(match[1])


def parse_size(text: str) -> int:
    """`20MB` (10^6 bytes each), `900kB`, `19MiB` or a number of bytes.

    Raises:
        ArgumentError: Not a size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-z]*)\s*", text, re.IGNORECASE)
    size = 0 if match is None else int(float(match[1]) * UNITS.get(match[2].lower(), 0))
    if size < 1:
        raise ArgumentError(f"max-size: expected a size, e.g. 20MB, got {text}")
    return size
