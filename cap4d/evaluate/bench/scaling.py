"""How the splatter's time grows with each thing that makes it grow."""

from __future__ import annotations

import logging
from typing import Any

from cap4d import _core
from cap4d.evaluate.bench.child import ChildError, in_child
from cap4d.evaluate.bench.passes import LANES, passes
from cap4d.evaluate.bench.scenes import Scene, SceneSource
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.timing import measure

log = logging.getLogger(__name__)

SIDES = (256, 384, 512, 768, 1024)  # px

Rows = list[dict[str, Any]]


def measure_scaling(scene: Scene, source: SceneSource, settings: Settings) -> dict[str, Rows]:
    """A table for each: picture size, threads, SH degree, instruction set."""
    sides = [side for side in SIDES if side <= settings.max_side]
    degrees = range(scene.gaussians.sh_degree + 1)
    return {
        "side": _timed("side", {side: (scene.resized(side), settings.threads) for side in sides}, settings),
        "threads": _timed("threads", {n: (scene, n) for n in range(1, settings.threads + 1)}, settings),
        "sh_degree": _timed(
            "sh_degree", {d: (scene.with_sh_degree(d), settings.threads) for d in degrees}, settings
        ),
        "isa": _over_instruction_sets(scene.name, source, settings),
    }


def measure_alone(
    *, folder: str | None, name: str, count: int | None, threads: int, runs: int
) -> dict[str, Any]:
    """One scene in a process of its own. Called through `child`."""
    timings = measure(passes(SceneSource(folder).load(name, count=count), threads=threads), runs=runs)
    return {"isa": _core.isa(), **{name: timing.report() for name, timing in timings.items()}}


def _timed(name: str, points: dict[int, tuple[Scene, int]], settings: Settings) -> Rows:
    """A row per point (its scene and number of threads), all points in turns."""
    log.info("splat: over %s", name)
    calls = {
        f"{point}/{kind}": call
        for point, (scene, threads) in points.items()
        for kind, call in passes(scene, threads=threads).items()
    }
    timings = measure(calls, runs=settings.short_runs)
    kinds = list(dict.fromkeys(key.split("/")[1] for key in calls))
    return [
        {name: point, **{kind: timings[f"{point}/{kind}"].report() for kind in kinds}} for point in points
    ]


def _over_instruction_sets(name: str, source: SceneSource, settings: Settings) -> Rows:
    """Those up to the one in use, each in a process of its own; one that fails is left out and said in the
    log.
    """
    log.info("splat: over isa")
    rows = []
    for isa in list(LANES)[: list(LANES).index(_core.isa()) + 1]:
        arguments = {
            "folder": source.folder,
            "name": name,
            "count": settings.count(name),
            "threads": settings.threads,
            "runs": settings.short_runs,
        }
        try:
            rows.append(in_child("splat", environment={"CAP4D_ISA": isa}, **arguments))
        except ChildError as error:
            log.warning("splat: instruction set %s: %s", isa, error)
    return rows
