"""Lines on standard input, which a pipe stands in for."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from receiving import Kept, line, running

from cap4d.drive.standard_input import StandardInputReceiver


@contextmanager
def piped() -> Iterator[tuple[StandardInputReceiver, Callable[[bytes], int], Callable[[], None]]]:
    reader, writer = os.pipe()
    try:
        yield StandardInputReceiver(reader), lambda data: os.write(writer, data), lambda: os.close(writer)
    finally:
        os.close(reader)


def test_standard_input_takes_lines_and_ends_with_its_end() -> None:
    with piped() as (receiver, write, close):
        sink, stop = Kept(), threading.Event()
        write(line(1.0) + b"garbage\n" + line(1.01).strip())
        close()
        receiver.run(sink, stop)  # returns, though nobody stopped it
        assert sink.stamps() == [1.0, 1.01] and sink.causes == {"syntax": 1}


def test_standard_input_stops_though_nothing_comes() -> None:
    with piped() as (receiver, write, close), running(receiver) as sink:
        write(line(1.0))
        sink.until(lambda: sink.stamps() == [1.0])
        close()


def test_standard_input_plays_a_file_at_its_own_speed() -> None:
    with piped() as (receiver, write, close), running(receiver) as sink:
        write(b"".join(line(i / 100) for i in range(100)))
        close()
        sink.until(lambda: len(sink.packets) == 100)
        assert sink.arrivals[-1] - sink.arrivals[0] > 0.9
