"""The avatars' pictures: passes of the deformer, where a frame's time goes, and speed against error."""

from __future__ import annotations

from typing import Any

import numpy as np

from cap4d.evaluate.bench.figure import AMBER, BLUE, FAINT, GREEN, INK, RED, VIOLET, add_axes

Report = dict[str, Any]
TIERS = {"full": BLUE, "fp16": VIOLET, "int8": GREEN, "linear": AMBER, "off": FAINT}
STAGES = (BLUE, RED, GREEN, AMBER, VIOLET, "#4f7ca8", "#a87c4f", "#5b8c5a")
SUMS = ("frame", "splat")  # of other stages
MARKERS = {384: "v", 256: "^"}  # of pictures drawn smaller, by their side


def draw_deformers(figure: Any, report: Report) -> None:
    """Milliseconds of a pass and the error of the vertices, an avatar a panel."""
    avatars = report["deformer"]
    figure.set_size_inches(12, 1.2 + 2.6 * len(avatars))
    for i, avatar in enumerate(avatars):
        axes = add_axes(
            figure, (len(avatars), 1, i + 1), f"{avatar['avatar']}: the deformer", "ms a frame", ""
        )
        bars = [(name, times["median_ms"], "", FAINT) for name, times in avatar["plain"].items()]
        for row in avatar["tiers"]:
            error = f", {row['error']['rms_mm']:.3f} mm RMS, {row['error']['max_mm']:.2f} mm at most"
            took = row["pass"]["median_ms"] if row["pass"] else 0.0
            bars.append((row["tier"], took, error, TIERS[row["tier"]]))
        names, times, errors, colours = zip(*bars[::-1], strict=True)
        drawn = axes.barh(range(len(bars)), times, 0.62, color=colours)
        labels = [f"{took:.2f} ms{error}" for took, error in zip(times, errors, strict=True)]
        axes.bar_label(drawn, labels, padding=4, fontsize=9)
        axes.set_yticks(range(len(bars)), names)
        axes.set_xlim(0, 1.5 * max(times))


def draw_frames(figure: Any, report: Report) -> None:
    """Where a frame's time goes, tier by tier."""
    avatars = report["frame"]
    figure.set_size_inches(12, 1.2 + 0.55 * sum(len(avatar["tiers"]) + 1.5 for avatar in avatars))
    names = list(dict.fromkeys(s for a in avatars for row in a["tiers"] for s in row["stages"]))
    colours = dict(zip([name for name in names if name not in SUMS], STAGES, strict=False))
    for i, avatar in enumerate(avatars):
        title = f"{avatar['avatar']}: a frame of {avatar['gaussians']:,} Gaussians at {avatar['side']} px"
        _frame_panel(add_axes(figure, (len(avatars), 1, i + 1), title, "ms, medians", ""), avatar, colours)


def _frame_panel(axes: Any, avatar: Report, colours: dict[str, str]) -> None:
    rows = avatar["tiers"][::-1]
    left = np.zeros(len(rows))
    for stage, colour in colours.items():
        widths = np.array([row["stages"].get(stage, {}).get("median_ms", 0.0) for row in rows])
        axes.barh(range(len(rows)), widths, 0.6, left=left, color=colour, label=stage)
        left += widths
    for y, row in enumerate(rows):
        axes.plot([row["median_ms"]] * 2, [y - 0.36, y + 0.36], color=INK, linewidth=1.5)
        text = f"{row['fps']:.0f} fps, {row['psnr_db']:.1f} dB"
        where = (max(left[y], row["median_ms"]), y)
        axes.annotate(text, where, xytext=(6, 0), textcoords="offset points", va="center", fontsize=9)
    axes.set_yticks(range(len(rows)), [row["name"] for row in rows])
    axes.set_xlim(0, 1.5 * max(left.max(), *(row["median_ms"] for row in rows)))
    axes.legend(
        frameon=False, fontsize=8, loc="center right", title="line: the whole frame", title_fontsize=8
    )


def draw_pareto(figure: Any, report: Report) -> None:
    """Frame time over error, every configuration; the line joins those that nothing beats in both."""
    avatars = report["frame"]
    figure.set_size_inches(9 * len(avatars), 7)
    for i, avatar in enumerate(avatars):
        title = f"{avatar['avatar']}: speed against error ({avatar['gaussians']:,} Gaussians)"
        label = f"PSNR against `{avatar['truth']}` in float64, dB (more is better)"
        _pareto_panel(add_axes(figure, (1, len(avatars), i + 1), title, label, "ms a frame"), avatar)


def _pareto_panel(axes: Any, avatar: Report) -> None:
    configurations = avatar["configurations"]
    best = pareto(configurations)
    axes.step(
        [c["psnr_db"] for c in best],
        [c["median_ms"] for c in best],
        where="post",
        color=INK,
        linewidth=1,
        alpha=0.5,
    )
    for c in configurations:
        small = c["side"] != avatar["side"]
        fill = "none" if small else "full"
        marker = MARKERS.get(c["side"], "o")
        at = (c["psnr_db"], c["median_ms"])
        axes.plot(*at, marker, color=TIERS[c["tier"]], markersize=8, fillstyle=fill)
        text = f"{c['side']} px" if small else f"SH {c['sh_degree']}"
        axes.annotate(text, at, xytext=(6, 4), textcoords="offset points", fontsize=7, color=FAINT)
    for tier in dict.fromkeys(c["tier"] for c in configurations):
        axes.plot([], [], "o", color=TIERS[tier], label=tier)
    axes.set_ylim(0, 1.25 * max(c["median_ms"] for c in configurations))
    axes.margins(x=0.1)
    note = f"filled: {avatar['side']} px; hollow: drawn smaller, enlarged"
    axes.legend(frameon=False, fontsize=9, loc="upper left", ncols=5, title=note, title_fontsize=8)


def pareto(configurations: list[Report]) -> list[Report]:
    """Those for which no other is both as fast and as exact, by rising PSNR."""
    best: list[Report] = []
    for c in sorted(configurations, key=lambda c: (-c["psnr_db"], c["median_ms"])):
        if not best or c["median_ms"] < best[-1]["median_ms"]:
            best.append(c)
    return best[::-1]
