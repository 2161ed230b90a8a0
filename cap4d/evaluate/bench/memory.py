"""How much memory a call needs on top of what is held already."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from cap4d.player.stages import peak_memory_mb

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
SAMPLE_S = 1e-3


def memory_of(call: Callable[[], object]) -> float:
    """MB that the process held at most during the call, less what it held before.

    Linux tells exactly where it lets the peak be set back; where it does not (some containers), what is held
    is read every millisecond and at the end; elsewhere it is by how much the call raised the peak.
    """
    gc.collect()  # garbage that goes during the call would hide what the call takes
    before = _status_mb("VmRSS")
    if before is None:
        peak = peak_memory_mb()
        call()
        return max(0.0, peak_memory_mb() - peak)
    with _sampled() as seen:
        exact = _reset_peak(before)
        call()
    return max(0.0, (_status_mb("VmHWM") if exact else None) or 0.0, *seen) - before


def peak_mb() -> float:
    """The most that this process has held, MB.

    On Linux not what `getrusage` says: that begins with what the process that started this one held.
    """
    return _status_mb("VmHWM") or peak_memory_mb()


def _reset_peak(held: float) -> bool:
    """Whether the peak now is what is held, MB, give or take what the question itself takes."""
    try:
        CLEAR.write_text("5")
    except OSError:
        return False
    return (_status_mb("VmHWM") or float("inf")) < held + 1


@contextmanager
def _sampled() -> Iterator[list[float]]:
    """What is held, MB: read every millisecond, and once at the end."""
    seen, done = [], threading.Event()

    def sample() -> None:
        while not done.wait(SAMPLE_S):
            seen.append(_status_mb("VmRSS") or 0.0)

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield seen
    finally:
        done.set()
        thread.join()
        seen.append(_status_mb("VmRSS") or 0.0)


def _status_mb(name: str) -> float | None:
    try:
        lines = STATUS.read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024 / 1e6
    return None
