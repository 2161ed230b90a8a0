"""The splatter's pictures: how time grows, how far from the roofs it is, and how far the peers are."""

from __future__ import annotations

from typing import Any

import numpy as np

from cap4d.evaluate.bench.figure import (
    FAINT,
    INK,
    PASSES,
    add_axes,
    add_title,
    nice_ticks,
    plain_ticks,
)

Report = dict[str, Any]
ROOFS = {"dram_read": ("memory", "-"), "llc_read": ("last-level cache", "--"), "l2_read": ("L2", ":")}


def draw_scaling(figure: Any, report: Report) -> None:
    """Time over work, picture size, SH degree, threads, instruction set; memory."""
    splat = report["splat"]
    figure.set_size_inches(14, 8.5)
    grid = figure.add_gridspec(2, 3)
    work = add_axes(figure, grid[0, 0], "Scenes", "blended pixel-Gaussian pairs, millions", "ms")
    _draw_work(work, splat)
    panels = (
        ("side", grid[0, 1], "Picture", "px a side"),
        ("sh_degree", grid[0, 2], "Spherical harmonics", "degree"),
        ("threads", grid[1, 0], "Threads", "threads"),
        ("isa", grid[1, 1], "Instruction set", "x86-64 level"),
    )
    for name, where, title, label in panels:
        _draw_curve(
            add_axes(figure, where, f"{title} ({splat['main']})", label, "ms"), splat["scaling"][name], name
        )
    _draw_memory(add_axes(figure, grid[1, 2], "Memory of a call", "", "MB"), splat)
    machine = report["machine"]["processor"]
    add_title(
        figure, f"Splatting on {splat['threads']} threads, {machine}: median, shaded to the 95th percentile"
    )


def _draw_work(axes: Any, splat: Report) -> None:
    rows = sorted(splat["scenes"], key=lambda row: row["work"]["blended"])
    x = [row["work"]["blended"] / 1e6 for row in rows]
    for key, (text, colour) in PASSES.items():
        axes.loglog(x, [row[key]["median_ms"] for row in rows], "o", color=colour, label=text)
        floors = [row["floor_ms"][key] for row in rows]
        axes.loglog(x, floors, "_", color=colour, markersize=16, markeredgewidth=1.5, label="its floor")
    for row, at in zip(rows, x, strict=True):
        where = (at, row["forward_backward"]["median_ms"])
        axes.annotate(row["name"], where, xytext=(0, 8), textcoords="offset points", ha="center", fontsize=7)
    lows = [row["floor_ms"]["forward"] for row in rows]
    highs = [row["forward_backward"]["median_ms"] for row in rows]
    axes.set_ylim(min(lows) / 1.5, max(highs) * 2)
    axes.set_xlim(min(x) / 1.6, max(x) * 1.8)
    plain_ticks(axes.xaxis, nice_ticks(min(x), max(x)))
    plain_ticks(axes.yaxis, nice_ticks(min(lows), max(highs)))
    axes.legend(frameon=False, fontsize=8, loc="lower right")


def _draw_curve(axes: Any, rows: list[Report], name: str) -> None:
    places = [row[name] for row in rows] if name == "side" else list(range(len(rows)))
    for key, (_, colour) in PASSES.items():
        medians, p95 = ([row[key][q] for row in rows] for q in ("median_ms", "p95_ms"))
        axes.plot(places, medians, "o-", color=colour)
        axes.fill_between(places, medians, p95, color=colour, alpha=0.15, linewidth=0)
        for place, median in zip(places, medians, strict=True):
            axes.annotate(
                f"{median:.3g}",
                (place, median),
                xytext=(0, 6),
                textcoords="offset points",
                fontsize=7,
                ha="center",
            )
    axes.set_xticks(places, [str(row[name]) for row in rows])
    axes.margins(x=0.1, y=0.15)
    axes.set_ylim(bottom=0)


def _draw_memory(axes: Any, splat: Report) -> None:
    rows = [row for row in splat["scenes"] if None not in row["memory_mb"].values()]
    for i, (key, (_, colour)) in enumerate(PASSES.items()):
        places = np.arange(len(rows)) + 0.4 * i - 0.2
        axes.bar_label(
            axes.bar(places, [row["memory_mb"][key] for row in rows], 0.38, color=colour),
            fmt="%.0f",
            fontsize=7,
        )
    axes.set_xticks(range(len(rows)), [row["name"] for row in rows], rotation=20, fontsize=8)


def draw_roofline(figure: Any, report: Report) -> None:
    """Operations per byte against operations per second: the machine's roofs, the passes as measured, and
    where each stage's floor stands.
    """
    splat, roofs = report["splat"], report["ceilings"][str(report["splat"]["threads"])]
    where = f"{splat['threads']} threads, {report['machine']['processor']}"
    title = f"Roofline of the splatter: {splat['main']}, {where}"
    axes = add_axes(figure, 111, title, "float32 operations per byte that has to be moved", "GFLOP/s")
    x = np.geomspace(0.3, 200, 200)
    for name, (text, style) in ROOFS.items():
        label = f"{text}, {roofs[name]:.0f} GB/s"
        axes.loglog(
            x, np.minimum(roofs["gflops"], roofs[name] * x), style, color=FAINT, linewidth=1.4, label=label
        )
    peak, offset = f"multiply-add peak, {roofs['gflops']:.0f} GFLOP/s", {"textcoords": "offset points"}
    axes.annotate(peak, (x[-1], roofs["gflops"]), xytext=(0, 4), ha="right", fontsize=9, **offset)
    for entry in splat["roofline"]:
        text, colour = PASSES[entry["name"]]
        intensity = entry["flops"] / entry["bytes"]
        reached, floor = (entry["flops"] / entry[k] * 1e-6 for k in ("ms", "floor_ms"))
        axes.plot([intensity] * 2, [reached, floor], color=colour, linewidth=1)
        axes.plot(
            intensity,
            reached,
            "o",
            color=colour,
            markersize=10,
            label=f"{text}: measured, {entry['ms']:.2f} ms",
        )
        axes.plot(intensity, floor, "D", color=colour, markersize=7, fillstyle="none",
                  label=f"{text}: floor, {entry['floor_ms']:.2f} ms")  # fmt: skip
    for stage in splat["roofline"][0]["measured"]:
        if stage["flops"]:
            _draw_stage(axes, stage)
    plain_ticks(axes.xaxis, [0.5, 1, 2, 5, 10, 20, 50, 100, 200])
    plain_ticks(axes.yaxis, [5, 10, 20, 50, 100, 200, 500])
    axes.set_ylim(5, 2 * roofs["gflops"])
    axes.legend(
        frameon=False, fontsize=9, loc="lower right", title="squares: stages of forward", title_fontsize=9
    )


def _draw_stage(axes: Any, stage: Report) -> None:
    """Measured, and at its floor."""
    intensity = stage["flops"] / stage["bytes"]
    heights = [stage["flops"] / stage[key] * 1e-6 for key in ("ms", "floor_ms")]
    axes.plot([intensity] * 2, heights, color=INK, linewidth=0.8)
    axes.plot(intensity, heights[0], "s", color=INK, markersize=7)
    axes.plot(intensity, heights[1], "s", color=INK, markersize=6, fillstyle="none")
    text = f"{stage['name']}: {stage['ms']:.2f} ms, floor {stage['floor_ms']:.2f}"
    axes.annotate(text, (intensity, heights[0]), xytext=(8, -4), textcoords="offset points", fontsize=9)


def draw_peers(figure: Any, report: Report) -> None:
    """Times of the peers beside ours, logarithmic."""
    scenes = report["peers"]["scenes"]
    figure.set_size_inches(12, 1.5 + 0.9 * sum(len(scene["rows"]) for scene in scenes))
    times = [row[key]["median_ms"] for scene in scenes for row in scene["rows"] for key in PASSES if row[key]]
    for i, scene in enumerate(scenes):
        last = i == len(scenes) - 1
        axes = add_axes(figure, (len(scenes), 1, i + 1), scene["name"], "ms" if last else "", "")
        rows = scene["rows"][::-1]
        for j, (key, (text, colour)) in enumerate(PASSES.items()):
            there = [(y + 0.2 - 0.4 * j, row) for y, row in enumerate(rows) if row[key]]
            values = [row[key]["median_ms"] for _, row in there]
            bars = axes.barh([place for place, _ in there], values, 0.36, color=colour, label=text)
            labels = [
                f"{value:,.1f} ms" + (f", {row[f'{key}_ratio']:.0f} x ours" if row["name"] != "ours" else "")
                for value, (_, row) in zip(values, there, strict=True)
            ]
            axes.bar_label(bars, labels, padding=4, fontsize=8)
        axes.set_xscale("log")
        axes.set_xlim(min(times) / 2, max(times) * 6)
        plain_ticks(axes.xaxis, nice_ticks(min(times), max(times)))
        axes.set_yticks(range(len(rows)), [row["name"] for row in rows])
    figure.axes[0].legend(frameon=False, fontsize=9, loc="upper right")
    add_title(figure, f"Peers on {report['peers']['threads']} threads, {report['machine']['processor']}")
