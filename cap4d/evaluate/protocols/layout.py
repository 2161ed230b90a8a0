"""The paper's tables in Markdown: rows are references and method, columns are metrics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from cap4d.evaluate.protocols.cell import Result
from cap4d.evaluate.protocols.gains import HIGHER, Gain, gain, standard_error

METRICS = ("PSNR", "LPIPS", "SSIM", "CSIM", "JOD", "AED", "APD", "AKD")
"""The paper's, in its order; whatever else was measured stands behind them."""
DECIMALS = {"PSNR": 2, "PSNR-fg": 2, "JOD": 2, "APD": 2, "APD-mp": 2, "AKD": 2, "gaze": 2}
METHODS = {
    "none": "ours",
    "unet": "without U-Net",
    "lpips": "without LPIPS",
    "remesh": "GaussianAvatars (the rig's triangles, no U-Net)",
    "mmdm": "without generated views",
}


def metrics_of(results: Iterable[Result]) -> list[str]:
    """Metrics that any cell has a number for, the paper's first."""
    found = {name: None for r in results for name in r.values if r.mean(name) is not None}
    return [m for m in METRICS if m in found] + [m for m in found if m not in METRICS]


def rows_of(results: Iterable[Result]) -> list[tuple[int, str]]:
    """(references, method) of all cells, in the order in which they were asked for."""
    return list(dict.fromkeys((len(r.cell.references), r.cell.method) for r in results))


def of_row(results: Iterable[Result], row: tuple[int, str]) -> list[Result]:
    """The cells of a row, one per identity."""
    return [r for r in results if (len(r.cell.references), r.cell.method) == row]


def mean_table(results: Sequence[Result]) -> list[str]:
    """Means over identities, of the mean over their views, with the standard error where there are two."""
    metrics = metrics_of(results)
    people = len({r.cell.identity for r in results})
    lines = _head(["references", "method", *map(_titled, metrics), "identities"])
    for row in rows_of(results):
        cells = of_row(results, row)
        numbers = [_spread(m, [r.mean(m) for r in cells]) for m in metrics]
        lines.append(_line([row[0], METHODS[row[1]], *numbers, f"{len(cells)}/{people}"]))
    return [*lines, ""]


def identity_table(results: Sequence[Result], identity: str) -> list[str]:
    """The same of one person: means over the views."""
    own = [r for r in results if r.cell.identity == identity]
    metrics = metrics_of(results)
    lines = _head(["references", "method", *map(_titled, metrics), "Gaussians", "fit"])
    for row in rows_of(own):
        for r in of_row(own, row):
            numbers = [_number(m, r.mean(m)) for m in metrics]
            size, seconds = f"{r.fit['gaussians']:,}", f"{r.fit['seconds']:.0f} s"
            lines.append(_line([row[0], METHODS[row[1]], *numbers, size, seconds]))
    return [*lines, ""]


def gains_of(results: Sequence[Result]) -> dict[str, list[Gain]]:
    """What the protocol asks: do more references help, and does what was left out."""
    rows, metrics = rows_of(results), metrics_of(results)
    pairs = {}
    for n, method in rows:
        more = [m for m, other in rows if other == method and m > n]
        if more:
            pairs[f"{counted(min(more))} over {n}, {METHODS[method]}"] = ((min(more), method), (n, method))
    for n, method in rows:
        if method != "none" and (n, "none") in rows:
            pairs[f"ours over {METHODS[method]}, {counted(n)}"] = ((n, "none"), (n, method))
    found = {}
    for title, (ours, theirs) in pairs.items():
        gains = [gain(m, of_row(results, ours), of_row(results, theirs)) for m in metrics]
        found[title] = [g for g in gains if g is not None]
    return found


def counted(references: int) -> str:
    """`10 references`"""
    return f"{references} reference{'s' if references != 1 else ''}"


def gain_table(results: Sequence[Result]) -> list[str]:
    """Mean paired gains over identities, and for how many of them the gain is one."""
    metrics = metrics_of(results)
    lines = _head(["gain (positive: better)", *metrics], words=1)
    for title, gains in gains_of(results).items():
        by_metric = {g.metric: g for g in gains}
        lines.append(_line([title, *(_gain(by_metric.get(m)) for m in metrics)]))
    return [*lines, ""]


def table(
    names: Sequence[str],
    metrics: Sequence[str],
    rows: Iterable[tuple[Sequence[object], Mapping[str, float | None], object]],
    last: str,
) -> list[str]:
    """A table whose rows are what they are called, a number per metric, and one thing more."""
    lines = _head([*names, *map(_titled, metrics), last])
    lines += [_line([*own, *(_number(m, numbers[m]) for m in metrics), end]) for own, numbers, end in rows]
    return [*lines, ""]


def _gain(g: Gain | None) -> str:
    if g is None:
        return "-"
    digits = _digits(g.metric)
    around = "" if g.error is None else f" ± {g.error:.{digits}f}"
    return f"{g.mean:+.{digits}f}{around} ({g.better}/{len(g.identities)})"


def _spread(metric: str, values: Sequence[float | None]) -> str:
    known = [v for v in values if v is not None]
    if not known:
        return "-"
    error = standard_error(known)
    around = "" if error is None else f" ± {error:.{_digits(metric)}f}"
    return _number(metric, float(np.mean(known))) + around


def _number(metric: str, value: float | None) -> str:
    return "-" if value is None else f"{value:.{_digits(metric)}f}"


def _digits(metric: str) -> int:
    return DECIMALS.get(metric, 3)


def _titled(metric: str) -> str:
    return metric + (" ↑" if metric in HIGHER else " ↓")


def _head(names: Sequence[str], *, words: int = 2) -> list[str]:
    """The first two lines of a table, of which so many columns are words, and all behind them numbers."""
    return [_line(names), _line(["---" if i < words else "---:" for i in range(len(names))])]


def _line(cells: Iterable[object]) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"
