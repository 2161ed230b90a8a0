"""What takes too long for the window's own thread: one thing after another in a thread beside it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any


@dataclass
class _Job:
    label: str
    work: Callable[[], Any]
    done: Callable[[Any], None]
    must_be_done: bool
    future: Future[Any] | None = None  # None: it did not begin


class Jobs:
    """Runs work in the background and hands its result over in the window's thread.

    Args:
        on_error: Receives what work, or taking its result over, raised; in the window's thread.
        executor: One worker; tests give one that does the work at once.
    """

    def __init__(self, on_error: Callable[[Exception], None], executor: Executor | None = None) -> None:
        self._on_error = on_error
        self._executor = executor or ThreadPoolExecutor(1, thread_name_prefix="cap4d-job")
        self._waiting: deque[_Job] = deque()

    @property
    def label(self) -> str | None:
        """What is being done, for the user; None: nothing."""
        return self._waiting[0].label if self._waiting else None

    def start(
        self, label: str, work: Callable[[], Any], done: Callable[[Any], None], *, must_be_done: bool = False
    ) -> None:
        """Does `work` as soon as the result of what was started before is taken over, as `work` may build on
        it; then calls `done` in `poll`. What `must_be_done` is done at the latest by `close`."""
        self._waiting.append(_Job(label, work, done, must_be_done))
        self._begin()

    def poll(self) -> bool:
        """Takes over what has finished; whether anything has."""
        finished = 0
        while self._waiting and self._waiting[0].future.done():
            job = self._waiting[0]
            finished += 1
            try:
                job.done(job.future.result())
            except Exception as error:  # whatever a file or a source did: the window goes on
                self._on_error(error)
            self._waiting.popleft()
            self._begin()
        return finished > 0

    def close(self) -> None:
        """Waits for what runs, and starts nothing more but what must be done."""
        self._executor.shutdown(wait=True, cancel_futures=True)
        left = [job for job in self._waiting if job.future is None or job.future.cancelled()]
        self._waiting.clear()
        for job in left:
            if job.must_be_done:
                job.work()

    def _begin(self) -> None:
        if self._waiting and self._waiting[0].future is None:
            self._waiting[0].future = self._executor.submit(self._waiting[0].work)
