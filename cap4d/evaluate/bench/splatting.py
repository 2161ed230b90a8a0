"""The splatter: time, error and memory on the standard scenes, and how time grows with each thing that makes
it grow.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from cap4d import _core
from cap4d.evaluate.bench.accuracy import picture_error
from cap4d.evaluate.bench.ceilings import Ceilings
from cap4d.evaluate.bench.child import ChildError, in_child
from cap4d.evaluate.bench.floor import backward_floor, floors_ms, forward_floor
from cap4d.evaluate.bench.memory import memory_of
from cap4d.evaluate.bench.scenes import NAMES, Scene, SceneSource
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.timing import measure
from cap4d.evaluate.bench.work import Work, count_work

log = logging.getLogger(__name__)

LANES = {"base": 4, "v3": 8, "v4": 16}
MAIN = "head_100k"  # what the scaling is measured on
SIDES = (256, 384, 512, 768, 1024)  # px
TABLE = ("head_30k", "head_100k", "head_300k", "bad_100k")
PASSES = ("forward", "forward_backward")


def lanes() -> int:
    """Floats in a register of the instruction set in use."""
    return LANES[_core.isa()]


def forward(scene: Scene, *, threads: int) -> Callable[[], Any]:
    """Drawing for the eye: nothing is kept for a gradient."""
    return lambda: _core.render(*scene.fields, *scene.view, None, -1, threads)


def forward_backward(scene: Scene, *, threads: int) -> Callable[[], Any]:
    """One step's splatting in fitting: the picture, then the gradients of means, quats, scales, opacities,
    sh and means2d for a fixed random gradient of the colours.
    """
    height, width = scene.camera.height, scene.camera.width
    v_rgb = np.random.default_rng(0).normal(size=(height, width, 3)).astype(np.float32)

    def step() -> Any:
        rgb, alpha, depth, _, _, rendered = _core.rasterize(*scene.fields, *scene.view, None, -1, threads)
        return _core.rasterize_vjp(rendered, *scene.fields, -1, rgb, alpha, depth, v_rgb, None, None, threads)

    return step


def both_passes(scene: Scene, *, threads: int) -> dict[str, Callable[[], Any]]:
    return {
        "forward": forward(scene, threads=threads),
        "forward_backward": forward_backward(scene, threads=threads),
    }


def measure_splatting(
    source: SceneSource, settings: Settings, ceilings: dict[int, Ceilings]
) -> dict[str, Any]:
    """Everything about the splatter that the report shows.

    Args:
        ceilings: By number of threads: one, and `settings.threads`.
    """
    scenes = {name: settings.load(source, name) for name in NAMES}
    log.info("splat: counting the work in float64")
    counted = {name: count_work(scene.gaussians, scene.camera) for name, scene in scenes.items()}
    log.info("splat: the standard scenes")
    times = _time_scenes(scenes, settings)
    rows = [
        {
            "name": name,
            "work": work.report(),
            **times[name],
            "error": picture_error(forward(scenes[name], threads=settings.threads)()[0], picture.rgb),
            "memory_mb": _alone(source, name, settings).get("memory_mb"),
            **_against_floor(times[name], work, ceilings[settings.threads]),
        }
        for name, (work, picture) in counted.items()
    ]
    main, work = scenes[MAIN], counted[MAIN][0]
    return {
        "isa": _core.isa(),
        "threads": settings.threads,
        "scenes": rows,
        "scaling": {
            "side": _over_sides(main, settings),
            "threads": _over_threads(main, settings),
            "sh_degree": _over_sh_degrees(main, settings),
            "isa": _over_instruction_sets(source, settings),
        },
        "roofline": roofline(work, ceilings[settings.threads], times[MAIN]),
    }


def roofline(work: Work, ceilings: Ceilings, times: dict[str, Any]) -> list[dict[str, Any]]:
    """Operations, bytes and, where it was timed, milliseconds of each pass and stage."""
    stages = {
        "forward": forward_floor(work, ceilings, lanes=lanes()),
        "forward_backward": forward_floor(work, ceilings, lanes=lanes())
        + backward_floor(work, ceilings, lanes=lanes()),
    }
    return [
        {
            "name": name,
            "flops": sum(stage.flops for stage in parts),
            "bytes": sum(stage.bytes for stage in parts),
            "floor_ms": round(sum(stage.ms for stage in parts), 3),
            "ms": times[name]["median_ms"],
            "stages": [stage.report() for stage in parts],
        }
        for name, parts in stages.items()
    ]


def measure_alone(
    *, folder: str | None, name: str, count: int | None, threads: int, runs: int
) -> dict[str, Any]:
    """One scene in a process of its own: times, memory, ceiling of the arithmetic. Called through `child`."""
    scene = SceneSource(folder).load(name, count=count)
    calls = both_passes(scene, threads=threads)
    memory = {name: round(memory_of(call), 1) for name, call in calls.items()}
    times = measure(calls, runs=runs)
    return {
        "isa": _core.isa(),
        "memory_mb": memory,
        "gflops": round(_core.multiply_add_rate(threads, 0.1) / 1e9, 1),
        **{name: timing.report() for name, timing in times.items()},
    }


def _time_scenes(scenes: dict[str, Scene], settings: Settings) -> dict[str, dict[str, Any]]:
    """Times of both passes of all scenes, one run of each in turn."""
    calls = {
        (name, kind): call
        for name, scene in scenes.items()
        for kind, call in both_passes(scene, threads=settings.threads).items()
    }
    timings = measure({"/".join(key): call for key, call in calls.items()}, runs=settings.runs)
    return {name: {kind: timings[f"{name}/{kind}"].report() for kind in PASSES} for name in scenes}


def _against_floor(times: dict[str, Any], work: Work, ceilings: Ceilings) -> dict[str, Any]:
    floors = floors_ms(work, ceilings, lanes=lanes())
    return {
        "floor_ms": {name: round(floor, 3) for name, floor in floors.items()},
        "of_floor": {name: round(floor / times[name]["median_ms"], 3) for name, floor in floors.items()},
    }


def _alone(source: SceneSource, name: str, settings: Settings, **environment: str) -> dict[str, Any]:
    """`measure_alone` there; an empty answer where the process failed (said in the log)."""
    try:
        return in_child(
            "splat",
            environment=environment,
            folder=source.folder,
            name=name,
            count=settings.count(name),
            threads=settings.threads,
            runs=settings.short_runs,
        )
    except ChildError as error:
        log.warning("splat: %s in a process of its own: %s", name, error)
        return {}


def _over_sides(main: Scene, settings: Settings) -> list[dict[str, Any]]:
    log.info("splat: over resolutions")
    return [
        {"side": side, **_timed(main.resized(side), settings)} for side in SIDES if side <= settings.max_side
    ]


def _over_threads(main: Scene, settings: Settings) -> list[dict[str, Any]]:
    log.info("splat: over threads")
    return [
        {"threads": threads, **_timed(main, settings, threads=threads)}
        for threads in range(1, settings.threads + 1)
    ]


def _over_sh_degrees(main: Scene, settings: Settings) -> list[dict[str, Any]]:
    log.info("splat: over SH degrees")
    return [
        {"sh_degree": degree, **_timed(main.with_sh_degree(degree), settings)}
        for degree in range(main.gaussians.sh_degree + 1)
    ]


def _over_instruction_sets(source: SceneSource, settings: Settings) -> list[dict[str, Any]]:
    """Those up to the one in use, each in its own process."""
    log.info("splat: over instruction sets")
    names = list(LANES)[: list(LANES).index(_core.isa()) + 1]
    rows = [_alone(source, MAIN, settings, CAP4D_ISA=name) for name in names]
    return [row for row in rows if row]


def _timed(scene: Scene, settings: Settings, *, threads: int | None = None) -> dict[str, Any]:
    calls = both_passes(scene, threads=threads or settings.threads)
    timings = measure(calls, runs=settings.short_runs)
    return {name: timing.report() for name, timing in timings.items()}
