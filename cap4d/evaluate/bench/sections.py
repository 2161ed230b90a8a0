"""The report's sections: what each measurement looks like on the page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cap4d.evaluate.bench.ceilings import ANCHORS, NAMES, UNITS
from cap4d.evaluate.bench.synthetic import STANDARD
from cap4d.evaluate.bench.table import table

Report = dict[str, Any]
PASSES = {"forward": "forward", "forward_backward": "forward + backward"}
SCALING = {
    "side": "picture, px a side",
    "threads": "threads",
    "sh_degree": "SH degree",
    "isa": "instruction set",
}
TIME_COLUMNS = ("forward", "p95", "forward + backward", "p95")


def ceilings(found: dict[str, Report]) -> Iterator[str]:
    yield from ("## The machine's ceilings", "")
    columns = {f"{n} thread{'s' * (int(n) > 1)}": rates for n, rates in found.items()}
    columns |= {f"anchors, {n}": rates.report() for n, rates in ANCHORS.items()}
    rows = (
        (f"{title}, {UNITS.get(name, 'GB/s')}", *(rates[name] for rates in columns.values()))
        for name, title in NAMES.items()
    )
    yield from table(("best of many goes", *columns), rows)


def splat(found: Report) -> Iterator[str]:
    yield from ("## The splatter", "")
    yield f"Scenes: {found['source']}. {found['threads']} threads, SH of degree 3."
    yield from ("", *_work(found["scenes"]))
    head = (
        "scene",
        "forward",
        "p95",
        "of floor",
        "stateless",
        "forward + backward",
        "p95",
        "of floor",
        "ns a pair",
    )
    yield from table(head, (_times(row) for row in found["scenes"]))
    yield "`forward` draws for the eye: Gaussians prepared once, colours in float16, as the player does it;"
    yield "`stateless` draws float32 Gaussians that may be others each time; `forward + backward` gives all"
    yield "gradients. `of floor`: the time that the counted work takes at the machine's ceilings (below),"
    yield "over the time measured. `ns a pair`: of `forward`, for each blended pixel-Gaussian pair."
    yield ""
    head = (
        "scene",
        "max, 1/255",
        "RMS, 1/255",
        "PSNR, dB",
        "stateless: max",
        "PSNR",
        "MB forward",
        "MB + backward",
    )
    yield from table(head, (_errors(row) for row in found["scenes"]))
    if found.get("gradients"):
        yield from _gradients(found["gradients"])
    for name, title in SCALING.items():
        rows = found["scaling"][name]
        yield from table((title, *TIME_COLUMNS), ((str(row[name]), *_medians(row)) for row in rows))
    yield from ("### Where the floor comes from", "")
    for entry in found["roofline"]:
        yield from _floor(entry, found["main"])


def _work(rows: list[Report]) -> Iterator[str]:
    def share(row: Report, name: str) -> str:
        standard = STANDARD.get(row["name"])
        return "-" if standard is None else f"{row['work'][name] / standard[name]:.3f}"

    names = ("gaussians", "pairs", "inside", "blended")
    head = (
        "scene",
        "Gaussians",
        "tile pairs",
        "pixels inside outlines",
        "blended",
        "standard: inside",
        "blended",
    )
    cells = (
        (row["name"], *(row["work"][name] for name in names), share(row, "inside"), share(row, "blended"))
        for row in rows
    )
    yield from table(head, cells)
    yield "`standard`: as a share of the counts of the standard scenes, the ones the targets were set on."
    yield ""


def _times(row: Report) -> tuple[object, ...]:
    cells = [(row[k]["median_ms"], row[k]["p95_ms"], f"{100 * row['of_floor'][k]:.0f} %") for k in PASSES]
    nanoseconds = row["forward"]["median_ms"] * 1e6 / max(1, row["work"]["blended"])
    return row["name"], *cells[0], row["stateless"]["median_ms"], *cells[1], nanoseconds


def _errors(row: Report) -> tuple[object, ...]:
    memory, error, alone = row["memory_mb"], row["error"], row["error"]["stateless"]
    errors = (error["max_255"], error["rms_255"], error["psnr_db"], alone["max_255"], alone["psnr_db"])
    return row["name"], *errors, *(memory.get(name) for name in PASSES)


def _medians(row: Report) -> tuple[object, ...]:
    return tuple(row[kind][name] for kind in PASSES for name in ("median_ms", "p95_ms"))


def _gradients(rows: list[Report]) -> Iterator[str]:
    names = [name for name in rows[0] if name != "name"]
    yield "Gradients against float64, relative norm of the difference:"
    yield ""
    yield from table(("scene", *names), ((r["name"], *(f"{r[n]:.1e}" for n in names)) for r in rows))


def _floor(entry: Report, scene: str) -> Iterator[str]:
    rows = [(s["name"], s["flops"] / 1e6, s["bytes"] / 1e6, s["ms"]) for s in entry["stages"]]
    total = ("total", entry["flops"] / 1e6, entry["bytes"] / 1e6, entry["floor_ms"])
    yield from table((f"{PASSES[entry['name']]}, {scene}", "MFLOP", "MB", "least ms"), [*rows, total])
    if "measured" in entry:
        yield "What stands between: medians of the splatter's stage times (`rasterize` blends and writes)."
        yield ""
        stages = ((s["name"], s["ms"], s["floor_ms"], s["ms"] - s["floor_ms"]) for s in entry["measured"])
        yield from table(("stage of forward", "measured", "floor", "between"), stages)


def fit(found: Report) -> Iterator[str]:
    yield from ("## The optimiser step of fitting", "")
    yield f"Adam on {found['gaussians']:,} Gaussians x {found['values'] // found['gaussians']} float32;"
    yield f"floor (every value, gradient and moment moved once): {found['floor_ms']:.2f} ms."
    yield ""
    rows = ((s["name"], s["median_ms"], s["p95_ms"], s["difference"]) for s in found["steps"])
    yield from table(("step", "median", "p95", "largest difference from torch after 10 steps"), rows)
    if "iteration" in found:
        yield from _iteration(found["iteration"])


def _iteration(found: Report) -> Iterator[str]:
    width, height = found["size"]
    yield f"Forward and backward of {found['gaussians']:,} Gaussians ({found['scene']}) at {width}x{height};"
    yield "times in turns, memory on top of the scene's own, each in a process of its own."
    yield ""
    rows = ((r["name"], r["median_ms"], r["p95_ms"], r["ratio"], r["memory_mb"]) for r in found["rows"])
    yield from table(("forward + backward", "median", "p95", "x ours", "memory, MB"), rows)


def deformer(avatars: list[Report]) -> Iterator[str]:
    yield from ("## The deformer", "")
    for avatar in avatars:
        size, truth = avatar["grid"], avatar["truth"]
        yield from (f"### {avatar['avatar']}", "")
        yield f"Grid {size} x {size}. Errors: of the deformable vertices against `{truth}`, over the"
        yield "expressions of the idle clip. `rig + deformer` is all that a frame's vertices take."
        yield ""
        plain = [(name, t["median_ms"], t["p95_ms"], *[None] * 4) for name, t in avatar["plain"].items()]
        yield from table(
            ("", "pass", "p95", "times faster than onnxruntime", "rig + deformer", "RMS, mm", "max, mm"),
            [*plain, *(_tier(row, avatar) for row in avatar["tiers"])],
        )


def _tier(row: Report, avatar: Report) -> tuple[object, ...]:
    network, error = row["pass"] or {}, row["error"]
    plain = next((t["median_ms"] for t in avatar["plain"].values()), None)
    faster = plain / network["median_ms"] if plain and network else None
    times = (network.get("median_ms"), network.get("p95_ms"), faster, row["vertices"]["median_ms"])
    return row["tier"], *times, error["rms_mm"], error["max_mm"]


def frame(avatars: list[Report]) -> Iterator[str]:
    yield from ("## Whole frames", "")
    columns = (
        "fps",
        "median_ms",
        "p95_ms",
        "p99_ms",
        "p99_over_median",
        "psnr_db",
        "memory_mb",
        "memory_grown_mb",
    )
    for avatar in avatars:
        side = avatar["side"]
        yield from (f"### {avatar['avatar']}", "")
        yield f"{avatar['gaussians']:,} Gaussians of SH degree {avatar['sh_degree']}, {side} px;"
        yield f"pictures against `{avatar['truth']}` drawn in float64, {avatar['samples']} frames."
        yield ""
        yield from table(
            (
                "tier",
                "fps",
                "median",
                "p95",
                "p99",
                "p99 / median",
                "PSNR, dB",
                "memory, MB",
                "grown since frame 5",
            ),
            ((row["name"], *(row.get(name) for name in columns)) for row in avatar["tiers"]),
        )
        stages = list(dict.fromkeys(stage for row in avatar["tiers"] for stage in row["stages"]))
        yield from table(
            ("median of each stage", *stages),
            (
                (row["name"], *(row["stages"].get(stage, {}).get("median_ms") for stage in stages))
                for row in avatar["tiers"]
            ),
        )


def optimize(found: Report) -> Iterator[str]:
    yield from (f"## `cap4d optimize` of {found['avatar']} at {found['limit_db']:.0f} dB", "")
    columns = ("bytes", "tier", "gaussians", "median_ms", "p95_ms", "psnr_db")
    head = ("avatar", "bytes", "tier", "Gaussians", "frame, median", "p95", "PSNR, dB")
    yield from table(head, ((row["name"], *(row[name] for name in columns)) for row in found["rows"]))
    yield from table(
        ("after the step", "bytes", "PSNR, dB"),
        ((s["name"], s["bytes"], s["psnr_db"]) for s in found["steps"]),
    )


def peers(found: Report) -> Iterator[str]:
    yield from ("## Peers", "")
    yield "In the same process, in turns with ours. gsplat's functions are given the list of blended pairs."
    yield ""
    for scene in found["scenes"]:
        yield from table(
            (scene["name"], "forward", "x ours", "forward + backward", "x ours", "PSNR, dB"),
            (_peer(row) for row in scene["rows"]),
        )


def _peer(row: Report) -> tuple[object, ...]:
    times = [((row[kind] or {}).get("median_ms"), row[f"{kind}_ratio"]) for kind in PASSES]
    return row["name"], *times[0], *times[1], row["error"]["psnr_db"]
