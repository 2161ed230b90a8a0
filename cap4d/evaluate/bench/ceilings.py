"""The machine's ceilings: what no algorithm can exceed on it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path

from cap4d import _core

CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
DEFAULT_CACHES = {2: 1 << 20, 3: 32 << 20}  # bytes, where the system does not say
SORT_KEYS = 100_000


@dataclass(frozen=True)
class Ceilings:
    """Rates of one number of threads.

    Args:
        gflops: float32 arithmetic, 1e9 operations/s; a multiply-add is two.
        dram_copy, llc_copy, l2_copy: GB/s read plus written, working set in memory, last-level, second-level
            cache.
        dram_read, llc_read, l2_read: GB/s.
        sort_pass: 1e9 keys/s through one pass of an 8-bit radix sort with values.
    """

    gflops: float
    dram_copy: float
    dram_read: float
    llc_copy: float
    llc_read: float
    l2_copy: float
    l2_read: float
    sort_pass: float

    def report(self) -> dict[str, float]:
        return {name: round(value, 3) for name, value in asdict(self).items()}


ANCHORS = {
    1: Ceilings(129.0, 10.1, 9.6, 18.0, 22.0, 55.0, 91.0, 0.21),
    2: Ceilings(244.0, 18.9, 19.2, 22.0, 34.0, 99.0, 160.0, 0.42),
}
"""The machine the targets in milliseconds were set on: two cores with AVX-512, November 2026. `sort_pass`
follows from its 0.95 ms for two passes over 100,000 keys on one thread.
"""

UNITS = {"gflops": "GFLOP/s", "sort_pass": "G keys/s"}  # of the others: GB/s
NAMES = {
    "gflops": "float32 multiply-add",
    "dram_copy": "memory, copy (read + write)",
    "dram_read": "memory, read",
    "llc_copy": "last-level cache, copy",
    "llc_read": "last-level cache, read",
    "l2_copy": "L2, copy",
    "l2_read": "L2, read",
    "sort_pass": "radix sort, one pass",
}
assert list(NAMES) == [field.name for field in fields(Ceilings)]


def measure_ceilings(threads: int, *, seconds: float = 0.3) -> Ceilings:
    """Measures them in the instruction set in use.

    Args:
        threads: At once.
        seconds: About how long each ceiling is looked for; its best moment counts.
    """
    l2, llc = (cache_bytes(level) for level in (2, 3))
    sets = {
        "dram": min(max(8 * llc, 256 << 20), 1 << 30),
        "llc": max(llc // 4, 2 * l2 * threads),
        "l2": l2 * threads // 2,
    }
    rates = {
        f"{name}_{kind}": rate(size, threads, seconds) / 1e9
        for name, size in sets.items()
        for kind, rate in (("copy", _core.copy_rate), ("read", _core.read_rate))
    }
    return Ceilings(
        gflops=_core.multiply_add_rate(threads, seconds) / 1e9,
        sort_pass=_core.sort_pass_rate(SORT_KEYS, threads, seconds) / 1e9,
        **rates,
    )


def cache_bytes(level: int, *, folder: Path = CACHES) -> int:
    """Size of a data cache as Linux tells it, or a usual one."""
    for index in sorted(folder.glob("index*")):
        try:
            kind, found, size = ((index / name).read_text().strip() for name in ("type", "level", "size"))
        except OSError:
            continue
        if kind != "Instruction" and found == str(level) and size.endswith("K") and size[:-1].isdigit():
            return int(size[:-1]) << 10
    return DEFAULT_CACHES[level]
