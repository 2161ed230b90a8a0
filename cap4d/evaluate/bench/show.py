"""The lines that a release must show: a number, its target, and whether it is met."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from cap4d.evaluate.bench.ceilings import Ceilings
from cap4d.evaluate.bench.fitting import FUSED, TORCH
from cap4d.evaluate.bench.floor import scaled_target_ms
from cap4d.evaluate.bench.work import Work

MAIN, FOG = "head_100k", "bad_100k"
FORWARD_MS, FORWARD_BACKWARD_MS = 8.0, 20.0  # two threads, at the ceilings of `ceilings.ANCHORS`
MOONSHOT_MS = {"forward": 6.0, "forward_backward": 15.0}
MAX_ERROR_255, MIN_PSNR_DB = 1.0, 50.0
INT8_SPEED_UP = 2.5
FPS = {"full": 25.0, "int8": 45.0, "linear": 80.0}
P99_OVER_MEDIAN = 2.0
SMALLER, FASTER = 4.0, 1.5
SCATTER = 1.03  # two measurements of the same thing
LINEAR_FREE_MS = 0.1  # of a frame: the scatter of two equal measurements


@dataclass(frozen=True)
class Show:
    """One line.

    Args:
        item: Of the list of what must be shown.
        text: What was measured and what was asked.
        passed: None where there is nothing to judge by.
    """

    item: int
    text: str
    passed: bool | None

    @property
    def line(self) -> str:
        mark = {True: "pass", False: "FAIL", None: "    "}[self.passed]
        return f"{mark}  {self.item}  {self.text}"

    def report(self) -> dict[str, Any]:
        return asdict(self)


def splatting_shows(splat: dict[str, Any], ceilings: Ceilings, *, lanes: int) -> Iterator[Show]:
    """Time, error and fraction of the floor on the main scene; how time grows over the scenes."""
    rows = {row["name"]: row for row in splat["scenes"]}
    main, threads = rows[MAIN], splat["threads"]
    work = work_of(main)
    targets = {"forward": FORWARD_MS, "forward_backward": FORWARD_BACKWARD_MS}
    for name, target in targets.items():
        yield _speed(main, name, target, work, ceilings, lanes=lanes, threads=threads)
    alone = main["stateless"]["median_ms"]
    yield Show(1, f"{MAIN} forward of float32 Gaussians, nothing prepared: {alone:.2f} ms", None)
    between = [f"{s['name']} {s['ms']:.2f} of {s['floor_ms']:.2f}" for s in splat["roofline"][0]["measured"]]
    yield Show(1, f"between the floor and forward, ms: {', '.join(between)}", None)
    error = main["error"]
    yield Show(
        1,
        f"{MAIN} against float64: max {error['max_255']:.3f}/255 (asked {MAX_ERROR_255:.0f}/255), "
        f"{error['psnr_db']:.1f} dB (asked {MIN_PSNR_DB:.0f})",
        error["max_255"] <= MAX_ERROR_255 and error["psnr_db"] >= MIN_PSNR_DB,
    )
    for name in ("head_30k", "head_300k", FOG):
        if name in rows:
            yield _growth(rows[name], main)


def _speed(
    row: dict[str, Any], name: str, target: float, work: Work, ceilings: Ceilings, *, lanes: int, threads: int
) -> Show:
    took = row[name]["median_ms"]
    here = scaled_target_ms(target, name, work, ceilings, lanes=lanes, threads=threads)
    return Show(
        1,
        f"{row['name']} {name.replace('_', ' + ')}, {threads} threads: {took:.2f} ms, asked {here:.2f} "
        f"here ({target:.0f} at the anchors' ceilings, where this is {took * target / here:.1f}; moonshot "
        f"{MOONSHOT_MS[name]:.0f}); {100 * row['of_floor'][name]:.0f} % of the floor of "
        f"{row['floor_ms'][name]:.2f}",
        took <= here,
    )


def _growth(row: dict[str, Any], main: dict[str, Any]) -> Show:
    """More blended pairs may take as much more time, fewer must not take more; and what the floor says to
    that.
    """
    time = row["forward"]["median_ms"] / main["forward"]["median_ms"]
    blended = row["work"]["blended"] / main["work"]["blended"]
    floor = row["floor_ms"]["forward"] / main["floor_ms"]["forward"]
    return Show(
        1,
        f"{row['name']} against {main['name']}: time x{time:.2f}, blended pairs x{blended:.2f}, "
        f"Gaussians x{row['work']['gaussians'] / main['work']['gaussians']:.1f}, floor x{floor:.2f}",
        time <= blended,
    )


def fitting_shows(fit: dict[str, Any]) -> Iterator[Show]:
    """The fit's optimiser step, torch's fused one, beside the plain one."""
    times = {step["name"]: step["median_ms"] for step in fit["steps"]}
    if TORCH in times and FUSED in times:
        fused, plain = times[FUSED], times[TORCH]
        yield Show(
            1,
            f"fused Adam, {fit['gaussians']:,} Gaussians: {fused:.2f} ms, {plain / fused:.1f} times as fast "
            f"as the plain one; {fit['floor_ms']:.2f} ms if every byte came from memory",
            fused <= SCATTER * plain,
        )
    if "iteration" in fit:
        yield from _iteration_shows(fit["iteration"])


def _iteration_shows(found: dict[str, Any]) -> Iterator[Show]:
    ours, *others = found["rows"]
    width, height = found["size"]
    what = f"forward + backward, {found['gaussians']:,} Gaussians, {width}x{height}"
    yield Show(1, f"{what}: {ours['median_ms']:.1f} ms, {_megabytes(ours)}", None)
    for other in others:
        theirs = f"{other['name']}: {other['median_ms']:.1f} ms, {_megabytes(other)}"
        yield Show(1, f"{what}, {theirs}; x{other['ratio']:.1f} ours", other["ratio"] > 1)


def _megabytes(row: dict[str, Any]) -> str:
    return "memory not measured" if row["memory_mb"] is None else f"{row['memory_mb']:.0f} MB"


def deformer_shows(avatar: dict[str, Any]) -> Iterator[Show]:
    """`full` beside plain onnxruntime, `int8` beside that, `linear` for nothing."""
    rows = {row["tier"]: row for row in avatar["tiers"]}
    plain = min((t["median_ms"] for t in avatar["plain"].values()), default=None)
    name = avatar["avatar"]
    if plain is not None and "full" in rows:
        full = rows["full"]["pass"]["median_ms"]
        yield Show(
            2, f"{name} full: {full:.2f} ms, plain onnxruntime {plain:.2f} ms", full <= SCATTER * plain
        )
    if plain is not None and "int8" in rows:
        int8, error = rows["int8"]["pass"]["median_ms"], rows["int8"]["error"]
        yield Show(
            2,
            f"{name} int8: {int8:.2f} ms, {plain / int8:.2f} times as fast as plain onnxruntime (asked "
            f"{INT8_SPEED_UP}); vertices {error['rms_mm']:.3f} mm RMS, {error['max_mm']:.3f} mm at most",
            plain / int8 >= INT8_SPEED_UP,
        )
    if "linear" in rows and "off" in rows:
        linear, off = (rows[tier]["vertices"]["median_ms"] for tier in ("linear", "off"))
        error = rows["linear"]["error"]
        yield Show(
            2,
            f"{name} linear: {linear - off:+.3f} ms over off (of {off:.2f}); vertices "
            f"{error['rms_mm']:.3f} mm RMS, {error['max_mm']:.3f} mm at most",
            linear - off <= LINEAR_FREE_MS,
        )


def frame_shows(avatar: dict[str, Any]) -> Iterator[Show]:
    """Frames a second of each tier, how even they are, and what they look like."""
    rows = {
        row["tier"]: row for row in sorted(avatar["tiers"], key=lambda row: row["fps"])
    }  # the fastest way stays
    for tier, wanted in FPS.items():
        if tier in rows:
            row = rows[tier]
            yield Show(
                3,
                f"{avatar['avatar']} {row['name']}, {avatar['gaussians']:,} Gaussians, {avatar['side']} "
                f"px: {row['fps']:.1f} fps (asked {wanted:.0f}), {row['psnr_db']:.1f} dB, p99 "
                f"{row['p99_over_median']:.2f} x median (asked {P99_OVER_MEDIAN:.0f})",
                row["fps"] >= wanted and row["p99_over_median"] <= P99_OVER_MEDIAN,
            )


def shrinking_shows(found: dict[str, Any]) -> Iterator[Show]:
    """How much smaller and faster `cap4d optimize` makes an avatar."""
    small = found["rows"][1]
    yield Show(
        4,
        f"{found['avatar']} at {found['limit_db']:.0f} dB: {found['smaller']:.2f} times smaller (asked "
        f"{SMALLER:.0f}), frames {found['faster']:.2f} times as fast (asked {FASTER}), pixels at "
        f"{small['psnr_db']:.1f} dB",
        found["smaller"] >= SMALLER and found["faster"] >= FASTER,
    )


def work_of(row: dict[str, Any]) -> Work:
    """The counts of a row of the table, whose JSON form has text for keys."""
    counts = dict(row["work"])
    return Work(**{**counts, "lanes": {int(k): v for k, v in counts["lanes"].items()}})


def verdict(shows: Iterable[Show]) -> str:
    """`7 of 9 lines pass`"""
    judged = [show.passed for show in shows if show.passed is not None]
    return f"{sum(judged)} of {len(judged)} lines pass"
