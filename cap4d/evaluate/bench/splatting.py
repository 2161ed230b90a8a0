"""The splatter: time, error and memory on the standard scenes."""

from __future__ import annotations

import importlib
import logging
from typing import Any

from cap4d import _core
from cap4d.evaluate.bench.accuracy import picture_error, relative_error
from cap4d.evaluate.bench.ceilings import Ceilings
from cap4d.evaluate.bench.child import ChildError, in_child
from cap4d.evaluate.bench.floor import floors_ms
from cap4d.evaluate.bench.memory import memory_of
from cap4d.evaluate.bench.passes import (
    PASSES,
    Playing,
    forward_backward,
    lanes,
    passes,
    random_gradient,
    stateless,
)
from cap4d.evaluate.bench.roofline import roofline
from cap4d.evaluate.bench.scaling import measure_scaling
from cap4d.evaluate.bench.scenes import NAMES, Scene, SceneSource
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.tiled import Picture
from cap4d.evaluate.bench.timing import measure
from cap4d.evaluate.bench.work import Work, count_work

log = logging.getLogger(__name__)

MAIN = "head_100k"  # what the scaling is measured on
GRADIENTS = "head_30k"  # what gradients are compared on: float64 autograd holds every pair, 2 GB here
FIELDS = ("means", "quats", "scales", "opacities", "sh")


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
    times, stages = _time_scenes(scenes, settings)
    rows = [
        {
            "name": name,
            "work": work.report(),
            **times[name],
            "error": _errors(scenes[name], picture, settings),
            "memory_mb": _memory(source, name, settings),
            **_against_floor(times[name], work, ceilings[settings.threads]),
        }
        for name, (work, picture) in counted.items()
    ]
    return {
        "source": source.kind,
        "main": MAIN,
        "isa": _core.isa(),
        "threads": settings.threads,
        "scenes": rows,
        **_gradients(scenes[GRADIENTS], settings),
        "roofline": roofline(counted[MAIN][0], ceilings[settings.threads], times[MAIN], stages),
        "scaling": measure_scaling(scenes[MAIN], source, settings),
    }


def memory_alone(
    *, folder: str | None, name: str, count: int | None, threads: int, kind: str
) -> dict[str, float]:
    """MB that one call needs in a process that has done nothing else. Called through `child`."""
    scene = SceneSource(folder).load(name, count=count)
    maker = {"forward": Playing, "forward_backward": forward_backward}[kind]
    return {"memory_mb": round(memory_of(lambda: maker(scene, threads=threads)()), 1)}


def gradient_errors(scene: Scene, *, threads: int) -> dict[str, float]:
    """Relative norm of the difference of each gradient from float64 autograd's.

    Raises:
        ModuleNotFoundError: torch is not installed.
    """
    torch = importlib.import_module("torch")
    from cap4d.raster.rasterize import rasterize

    fields = [torch.from_numpy(field).double().requires_grad_() for field in scene.fields]
    picture = rasterize(*fields, camera=scene.camera, backend="reference")
    picture.rgb.backward(torch.from_numpy(random_gradient(scene)).double())
    found = forward_backward(scene, threads=threads)()
    truth = [field.grad.numpy() for field in fields]
    return {
        name: relative_error(ours, theirs)
        for name, ours, theirs in zip(FIELDS, found[: len(FIELDS)], truth, strict=True)
    }


def _gradients(scene: Scene, settings: Settings) -> dict[str, Any]:
    log.info("splat: gradients in float64")
    try:
        return {"gradients": [{"name": scene.name, **gradient_errors(scene, threads=settings.threads)}]}
    except ModuleNotFoundError as error:
        return {"not_measured": [f"gradients against float64: need the package {error.name}"]}


def _time_scenes(
    scenes: dict[str, Scene], settings: Settings
) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """Times of all passes of all scenes, one run of each in turn; and the stages of `MAIN`'s forward."""
    ready = {name: passes(scene, threads=settings.threads) for name, scene in scenes.items()}
    calls = {f"{name}/{kind}": call for name, kinds in ready.items() for kind, call in kinds.items()}
    timings = measure(calls, runs=settings.runs)
    times = {name: {kind: timings[f"{name}/{kind}"].report() for kind in PASSES} for name in scenes}
    return times, ready[MAIN]["forward"].stage_ms()


def _errors(scene: Scene, truth: Picture, settings: Settings) -> dict[str, Any]:
    """Of the pictures of `forward` and, in its own entry, `stateless`."""
    pictures = [make(scene, threads=settings.threads)()[0] for make in (Playing, stateless)]
    return {**picture_error(pictures[0], truth.rgb), "stateless": picture_error(pictures[1], truth.rgb)}


def _memory(source: SceneSource, name: str, settings: Settings) -> dict[str, float | None]:
    """By pass; None where the process failed, which the log says, or for most of a quick run."""
    found: dict[str, float | None] = {}
    for kind in ("forward", "forward_backward"):
        if settings.quick and name != MAIN:
            found[kind] = None
            continue
        arguments = {"folder": source.folder, "name": name, "count": settings.count(name)}
        try:
            answer = in_child("memory", **arguments, threads=settings.threads, kind=kind)
            found[kind] = answer["memory_mb"]
        except ChildError as error:
            log.warning("splat: memory of %s: %s", name, error)
            found[kind] = None
    return found


def _against_floor(times: dict[str, Any], work: Work, ceilings: Ceilings) -> dict[str, Any]:
    floors = floors_ms(work, ceilings, lanes=lanes())
    return {
        "floor_ms": {name: round(floor, 3) for name, floor in floors.items()},
        "of_floor": {name: round(floor / times[name]["median_ms"], 3) for name, floor in floors.items()},
    }
