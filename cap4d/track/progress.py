"""A line that says how far a long loop is and how long it will still take."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
PERIOD = 5.0  # s between lines

log = logging.getLogger(__name__)


def progress(items: Iterable[T], label: str, count: int) -> Iterator[T]:
    """Passes `items` on, logging `label: done/count, seconds left` every few seconds (count 0: unknown)."""
    start = said = time.monotonic()
    for done, item in enumerate(items):
        now = time.monotonic()
        if done and now - said > PERIOD:
            said = now
            left = f"/{count}, {(now - start) / done * (count - done):.0f} s left" if count > done else ""
            log.info("%s: %d%s", label, done, left)
        yield item
