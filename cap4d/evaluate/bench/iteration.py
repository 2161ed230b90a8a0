"""The rendering half of a step of fitting: forward and backward of one picture, beside what else can do it.

gsplat's PyTorch reference is given its list of pairs (see `peers`), so it does less than a renderer must.
"""

from __future__ import annotations

import logging
from typing import Any

from cap4d.errors import Cap4dError
from cap4d.evaluate.bench.child import in_child
from cap4d.evaluate.bench.memory import memory_of
from cap4d.evaluate.bench.passes import forward_backward
from cap4d.evaluate.bench.peers import REST_S, gsplat_peer
from cap4d.evaluate.bench.scenes import SceneSource
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.timing import measure

log = logging.getLogger(__name__)

SCENE = "head_100k"
OURS, GSPLAT = "ours", "gsplat's PyTorch functions, pairs given"
OPENSPLAT = "OpenSplat's CPU rasteriser: it is built from its sources, which this bench does not do"


def measure_iteration(source: SceneSource, settings: Settings) -> dict[str, Any]:
    """Times in turns, memory each in a process of its own."""
    log.info("fit: forward and backward of %s", SCENE)
    scene = settings.load(source, SCENE)
    calls = {OURS: forward_backward(scene, threads=settings.threads)}
    missing = [OPENSPLAT]
    try:
        calls[GSPLAT] = gsplat_peer(scene, settings).forward_backward
    except ModuleNotFoundError as error:
        missing.append(f"{GSPLAT}: needs the package {error.name}")
    timings = measure(calls, runs=settings.slow_runs, rest_s=REST_S)
    ours = timings[OURS].median_ms
    rows = [
        {
            "name": name,
            **timing.report(),
            "ratio": round(timing.median_ms / ours, 2),
            "memory_mb": _memory(name, source, settings, missing),
        }
        for name, timing in timings.items()
    ]
    camera = scene.camera
    return {
        "scene": SCENE,
        "gaussians": len(scene.fields[0]),
        "size": [camera.width, camera.height],
        "rows": rows,
        "not_measured": missing,
    }


def _memory(name: str, source: SceneSource, settings: Settings, missing: list[str]) -> float | None:
    """MB on top of the scene's own."""
    folder = None if settings.scenes is None else str(settings.scenes)
    try:
        found = in_child(
            "iteration", folder=folder, name=name, threads=settings.threads, quick=settings.quick
        )
    except Cap4dError as error:
        missing.append(f"memory of {name}: {error}")
        return None
    return found["memory_mb"]


def memory_alone(*, folder: str | None, name: str, threads: int, quick: bool) -> dict[str, float]:
    """MB that one call needs in a process that has done nothing else. Called through `child`."""
    settings = Settings(threads=threads, quick=quick, scenes=folder)
    scene = settings.load(SceneSource(folder), SCENE)
    if name == OURS:
        call = forward_backward(scene, threads=threads)
    else:
        call = gsplat_peer(scene, settings).forward_backward
    return {"memory_mb": round(memory_of(call), 1)}
