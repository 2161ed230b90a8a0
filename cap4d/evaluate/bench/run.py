"""`cap4d bench`: every section that was asked for, then the report."""

from __future__ import annotations

import logging
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from cap4d.bundle.reader import read_bundle
from cap4d.errors import ArgumentError
from cap4d.evaluate.bench.ceilings import Ceilings, measure_ceilings
from cap4d.evaluate.bench.deforming import measure_deformer
from cap4d.evaluate.bench.fitting import measure_fitting
from cap4d.evaluate.bench.frames import measure_frames
from cap4d.evaluate.bench.iteration import measure_iteration
from cap4d.evaluate.bench.machine import describe_machine
from cap4d.evaluate.bench.passes import lanes
from cap4d.evaluate.bench.peers import measure_peers
from cap4d.evaluate.bench.plots import draw_plots
from cap4d.evaluate.bench.report import write_report
from cap4d.evaluate.bench.scenes import SceneSource, check_folder
from cap4d.evaluate.bench.settings import SECTIONS, Settings
from cap4d.evaluate.bench.show import (
    Show,
    deformer_shows,
    fitting_shows,
    frame_shows,
    shrinking_shows,
    splatting_shows,
    verdict,
)
from cap4d.evaluate.bench.shrinking import measure_shrinking
from cap4d.evaluate.bench.splatting import measure_splatting

log = logging.getLogger(__name__)

Report = dict[str, Any]
HARD_CASES = "item 5, the hard cases: they are tests; `make sanitize` runs them under the sanitizers"


def bench(folder: Path, settings: Settings) -> Report:
    """Measures, writes `report.md`, `report.json` and plots into `folder`, prints what must be shown.

    Args:
        folder: Made when missing; its parent must exist.
    Raises:
        ArgumentError, DataError: Before anything is measured.
    """
    source = SceneSource() if settings.scenes is None else check_folder(settings.scenes)
    for path in settings.avatars:
        read_bundle(path)
    prepare_folder(folder)
    report: Report = {
        "command": command(folder, settings),
        "machine": describe_machine(settings.threads),
        "quick": settings.quick,
        "not_measured": [],
    }
    ceilings = find_ceilings(settings)
    report["ceilings"] = {str(n): found.report() for n, found in ceilings.items()}
    measure_sections(report, source, settings, ceilings)
    shows = find_shows(report, ceilings[settings.threads])
    report["shows"] = [show.report() for show in shows]
    plots = try_plots(folder, report)
    write_report(folder, report, plots)
    for line in (*(show.line for show in shows), *(f"not measured: {m}" for m in report["not_measured"])):
        print(line)
    said = "--quick: the numbers mean nothing" if settings.quick else verdict(shows)
    print(f"{folder / 'report.md'}: {said}")
    return report


def find_ceilings(settings: Settings) -> dict[int, Ceilings]:
    """For one thread and for all."""
    log.info("ceilings")
    threads = sorted({1, settings.threads})
    return {n: measure_ceilings(n, seconds=settings.ceiling_seconds) for n in threads}


def measure_sections(
    report: Report, source: SceneSource, settings: Settings, ceilings: dict[int, Ceilings]
) -> None:
    """Adds what each section measured, and a line to `not_measured` for what could not be."""
    missing = report["not_measured"]
    missing.append(HARD_CASES)
    if "splat" in settings.sections:
        report["splat"] = measure_splatting(source, settings, ceilings)
        missing += report["splat"].pop("not_measured", [])
    if "fit" in settings.sections:
        report["fit"] = measure_fitting(settings, ceilings[settings.threads])
        missing += report["fit"].pop("not_measured")
        report["fit"]["iteration"] = measure_iteration(source, settings)
        missing += report["fit"]["iteration"].pop("not_measured")
    for name, measure in (("deformer", measure_deformer), ("frame", measure_frames)):
        if name in settings.sections and settings.avatars:
            report[name] = [measure(path, settings) for path in settings.avatars]
        elif name in settings.sections:
            missing.append(f"{name}: needs an avatar (--avatar FILE)")
    if "optimize" in settings.sections:
        measure_optimize(report, settings)
    if "peers" in settings.sections:
        report["peers"] = measure_peers(source, settings)
        missing += report["peers"].pop("not_measured")


def measure_optimize(report: Report, settings: Settings) -> None:
    """The first avatar's; it takes minutes, too long for a quick run."""
    if settings.quick or not settings.avatars:
        why = "takes minutes, left out of --quick" if settings.quick else "needs an avatar (--avatar FILE)"
        report["not_measured"].append(f"optimize: {why}")
        return
    try:
        report["optimize"] = measure_shrinking(settings.avatars[0], settings)
    except ModuleNotFoundError as error:
        report["not_measured"].append(f"optimize: needs the package {error.name}")


def find_shows(report: Report, ceilings: Ceilings) -> list[Show]:
    """The lines of the sections that ran; without a verdict when they were made with `quick`."""
    shows: list[Show] = []
    if "splat" in report:
        shows += splatting_shows(report["splat"], ceilings, lanes=lanes())
    if "fit" in report:
        shows += fitting_shows(report["fit"])
    for avatar in report.get("deformer", ()):
        shows += deformer_shows(avatar)
    for avatar in report.get("frame", ()):
        shows += frame_shows(avatar)
    if "optimize" in report:
        shows += shrinking_shows(report["optimize"])
    return [replace(show, passed=None) for show in shows] if report["quick"] else shows


def try_plots(folder: Path, report: Report) -> list[str]:
    """The plots' names; none, and a line in the report, without matplotlib."""
    try:
        return draw_plots(folder, report)
    except ModuleNotFoundError as error:
        report["not_measured"].append(f"plots: need the package {error.name}")
        return []


def prepare_folder(folder: Path) -> None:
    """Makes the report's folder.

    Raises:
        ArgumentError: It cannot be one.
    """
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(f"report: expected a folder, found a file at {folder}")
    if not folder.parent.is_dir():
        raise ArgumentError(f"report: the folder {folder.parent} does not exist")
    folder.mkdir(exist_ok=True)


def parse_sections(text: str) -> tuple[str, ...]:
    """`splat,fit` -> ("splat", "fit"); spaces may stand for commas.

    Raises:
        ArgumentError: One of them is not a section.
    """
    wanted = tuple(name.strip() for name in text.replace(" ", ",").split(",") if name.strip()) or ("",)
    for name in wanted:
        if name not in SECTIONS:
            raise ArgumentError(f"sections: expected names of {', '.join(SECTIONS)}, got {name or 'nothing'}")
    return wanted


def command(folder: Path, settings: Settings) -> str:
    """The command line that does the same again."""
    sections = () if settings.sections == SECTIONS else settings.sections
    words = ["cap4d", "bench", *sections, "--report", str(folder), "--threads", str(settings.threads)]
    if settings.scenes is not None:
        words += ["--scenes", str(settings.scenes)]
    if settings.avatars:
        words += ["--avatar", *map(str, settings.avatars)]
    return shlex.join([*words, *["--quick"] * settings.quick])
