"""The report: JSON with every number, Markdown with tables and plots for people."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from cap4d.atomic import replacing
from cap4d.evaluate.bench import protocol, sections
from cap4d.evaluate.bench.table import table

SCHEMA = 1

Report = dict[str, Any]


def write_report(folder: Path, report: Report, plots: Sequence[str]) -> None:
    """`report.json` and `report.md`.

    Args:
        folder: There already, with the plots in it.
        plots: Their file names; each begins with the name of its section.
    """
    with replacing(folder / "report.json") as temporary:
        temporary.write_text(json.dumps({"schema": SCHEMA, **report}, indent=1) + "\n")
    with replacing(folder / "report.md") as temporary:
        temporary.write_text(markdown(report, plots))


def markdown(report: Report, plots: Sequence[str]) -> str:
    """The whole page."""
    writers: dict[str, Callable[[Any], Iterable[str]]] = {
        "ceilings": sections.ceilings,
        "splat": sections.splat,
        "fit": sections.fit,
        "deformer": sections.deformer,
        "frame": sections.frame,
        "optimize": sections.optimize,
        "peers": sections.peers,
    }
    lines = ["# Speed against error", ""]
    if report["quick"]:
        lines += ["Made with `--quick`, to see that it runs: **the numbers mean nothing.**", ""]
    lines += [*machine(report["machine"]), *shows(report["shows"])]
    for name, write in writers.items():
        if name in report:
            lines += write(report[name])
            lines += [text for plot in plots if plot.startswith(name) for text in (f"![{plot}]({plot})", "")]
    if report["not_measured"]:
        lines += ["## Not measured", "", *(f"- {line}" for line in report["not_measured"]), ""]
    return "\n".join([*lines, *protocol.markdown(report["command"])])


def machine(found: Report) -> Iterator[str]:
    packages = ", ".join(f"{name} {found[name]}" for name in ("numpy", "onnxruntime", "torch") if found[name])
    yield f"{found['processor']}, {found['cores']} cores, {found['threads']} threads used,"
    yield f"inner loops: {found['isa']}; {found['system']}, Python {found['python']},"
    yield f"cap4d {found['cap4d']}, {packages}; load before the run {found['load_1_min']}."
    yield from ("Times are milliseconds.", "")


def shows(lines: list[Report]) -> Iterator[str]:
    yield from ("## What it must show", "")
    marks = {True: "pass", False: "**FAIL**", None: ""}
    yield from table(("", "item", "measured"), ((marks[s["passed"]], s["item"], s["text"]) for s in lines))
