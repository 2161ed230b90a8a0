"""Ctrl-C while a fit runs: the step is finished first, so that what is saved is a whole one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class Pause:
    """Whether somebody asked to stop.

    Attributes:
        asked: True from the first Ctrl-C on.
    """

    def __init__(self) -> None:
        self.asked = False


@contextmanager
def pausing() -> Iterator[Pause]:
    """Turns the first Ctrl-C of the body into `Pause.asked`; the second one interrupts as usual.

    Outside the main thread, which alone gets signals, nothing changes.
    """
    pause = Pause()
    if threading.current_thread() is not threading.main_thread():
        yield pause
        return
    before = signal.getsignal(signal.SIGINT)

    def ask(*_: object) -> None:
        pause.asked = True
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask)
    try:
        yield pause
    finally:
        signal.signal(signal.SIGINT, before)
