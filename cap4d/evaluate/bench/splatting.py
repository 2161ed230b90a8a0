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
from cap4d.evaluate.bench.floor import Stage, backward_floor, floors_ms, forward_floor, total_ms
from cap4d.evaluate.bench.memory import memory_of
from cap4d.evaluate.bench.scenes import NAMES, Scene, SceneSource
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.tiled import Picture
from cap4d.evaluate.bench.timing import measure
from cap4d.evaluate.bench.work import Work, count_work

log = logging.getLogger(__name__)

LANES = {"base": 4, "v3": 8, "v4": 16}
MAIN = "head_100k"  # what the scaling is measured on
SIDES = (256, 384, 512, 768, 1024)  # px
TABLE = ("head_30k", "head_100k", "head_300k", "bad_100k")
PASSES = ("forward", "stateless", "forward_backward")
STAGES = {"project": ("project",), "sort": ("sort",), "tiles": ("bin",), "rasterize": ("blend", "write")}
"""Stages that the splatter times -> those of the floor that they do."""


def lanes() -> int:
    """Floats in a register of the instruction set in use."""
    return LANES[_core.isa()]


class Playing:
    """Drawing for the eye as a player does: Gaussians prepared once (colours in float16), buffers kept.

    Calling it draws; `seconds` collects what each stage of each call took.
    """

    def __init__(self, scene: Scene, *, threads: int) -> None:
        self._splatter = _core.Splatter(*scene.fields)
        self._view, self._threads = scene.view, threads
        self.seconds: list[dict[str, float]] = []

    def __call__(self) -> tuple[np.ndarray, ...]:
        image = self._splatter.render(*self._view, threads=self._threads)
        self.seconds.append(self._splatter.seconds)
        return image

    def stage_ms(self) -> dict[str, float]:
        """Median milliseconds of each stage."""
        return {
            stage: round(1e3 * float(np.median([seconds[stage] for seconds in self.seconds])), 4)
            for stage in STAGES
        }


def stateless(scene: Scene, *, threads: int) -> Callable[[], Any]:
    """Drawing Gaussians that may be others each time, in single precision."""
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


def passes(scene: Scene, *, threads: int) -> dict[str, Callable[[], Any]]:
    """Ready to be timed, by the names of `PASSES`."""
    makers = (Playing, stateless, forward_backward)
    return {name: make(scene, threads=threads) for name, make in zip(PASSES, makers, strict=True)}


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
            "error": _errors(scenes[name], picture, settings),
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
        "roofline": roofline(work, ceilings[settings.threads], times[MAIN], stage_times(main, settings)),
    }


def roofline(
    work: Work, ceilings: Ceilings, times: dict[str, Any], measured: dict[str, float]
) -> list[dict[str, Any]]:
    """Operations, bytes, floor and milliseconds of `forward`, stage by stage, and of `forward_backward`.

    Args:
        measured: See `stage_times`.
    """
    play = forward_floor(work, ceilings, lanes=lanes(), half_sh=True)
    train = forward_floor(work, ceilings, lanes=lanes()) + backward_floor(work, ceilings, lanes=lanes())
    found = [
        {
            "name": name,
            "flops": sum(stage.flops for stage in parts),
            "bytes": sum(stage.bytes for stage in parts),
            "floor_ms": round(total_ms(parts), 3),
            "ms": times[name]["median_ms"],
            "stages": [stage.report() for stage in parts],
        }
        for name, parts in (("forward", play), ("forward_backward", train))
    ]
    found[0]["measured"] = [_measured(name, ms, play) for name, ms in measured.items()]
    return found


def _measured(name: str, ms: float, floor: list[Stage]) -> dict[str, Any]:
    parts = [stage for stage in floor if stage.name in STAGES[name]]
    sums = {key: sum(getattr(stage, key) for stage in parts) for key in ("flops", "bytes")}
    return {"name": name, "ms": ms, "floor_ms": round(total_ms(parts), 4), **sums}


def measure_alone(
    *, folder: str | None, name: str, count: int | None, threads: int, runs: int
) -> dict[str, Any]:
    """One scene in a process of its own: times, memory, ceiling of the arithmetic. Called through `child`."""
    scene = SceneSource(folder).load(name, count=count)
    calls = passes(scene, threads=threads)
    memory = {
        "forward": round(memory_of(lambda: forward(scene, threads=threads)()), 1),
        "forward_backward": round(memory_of(calls["forward_backward"]), 1),
    }
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
        for kind, call in passes(scene, threads=settings.threads).items()
    }
    timings = measure({"/".join(key): call for key, call in calls.items()}, runs=settings.runs)
    return {name: {kind: timings[f"{name}/{kind}"].report() for kind in PASSES} for name in scenes}


def _errors(scene: Scene, truth: Picture, settings: Settings) -> dict[str, Any]:
    """Of the pictures of `forward` and, in its own entry, `stateless`."""
    pictures = [make(scene, threads=settings.threads)()[0] for make in (Playing, stateless)]
    return {**picture_error(pictures[0], truth.rgb), "stateless": picture_error(pictures[1], truth.rgb)}


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
    calls = passes(scene, threads=threads or settings.threads)
    timings = measure(calls, runs=settings.short_runs)
    return {name: timing.report() for name, timing in timings.items()}
