"""How much memory a call needs on top of what is held already."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cap4d.player.stages import peak_memory_mb

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def memory_of(call: Callable[[], object]) -> float:
    """MB that the process held at most during the call, less what it held before.

    Linux tells exactly (the peak is set back first); elsewhere it is by how much the call raised the peak.
    """
    before = _resident_mb()
    if before is None:
        peak = peak_memory_mb()
        call()
        return max(0.0, peak_memory_mb() - peak)
    call()
    return max(0.0, (_status_mb("VmHWM") or before) - before)


def peak_mb() -> float:
    """The most that this process has held, MB.

    On Linux not what `getrusage` says: that begins with what the process that started this one held.
    """
    return (_status_mb("VmHWM") if STATUS.is_file() else None) or peak_memory_mb()


def _resident_mb() -> float | None:
    """What is held now, with the peak set back to it; None where the system does not do that."""
    try:
        CLEAR.write_text("5")
        return _status_mb("VmRSS")
    except OSError:
        return None


def _status_mb(name: str) -> float | None:
    for line in STATUS.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024 / 1e6
    return None
