"""The deformer, tier by tier: milliseconds of a pass and millimetres of error, beside plain onnxruntime."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from cap4d.errors import ArgumentError
from cap4d.evaluate.bench.accuracy import vertex_error_mm
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.tiers import clip_frames, load_tiers, offset_maps, vertices_of
from cap4d.evaluate.bench.timing import measure
from cap4d.player.avatar import Avatar

log = logging.getLogger(__name__)

REST_S = 0.05  # plain onnxruntime's threads spin for a while after a pass
EXPRESSIONS = 24  # frames that times and errors are taken over
PLAIN, RESTING = "onnxruntime, as it comes", "onnxruntime, threads that do not spin"


def measure_deformer(path: Path, settings: Settings) -> dict[str, Any]:
    """One avatar: a row per tier, and the exported network in onnxruntime without us.

    Raises:
        ArgumentError: An avatar on the rig's own triangles, which has none.
    """
    log.info("deformer: %s", path)
    tiers = load_tiers(path, threads=settings.threads)
    bundle = next(iter(tiers.values())).bundle
    if bundle.grid.is_mesh:
        raise ArgumentError(f"{path}: expected an avatar on a UV grid, got one without a deformer to measure")
    frames = clip_frames(bundle, EXPRESSIONS)
    maps = offset_maps(bundle, frames)
    passes: dict[str, Callable[[], Any]] = {}
    if bundle.deform_onnx is not None:
        for name, spinning in ((PLAIN, True), (RESTING, False)):
            passes[name] = _plain_pass(bundle.deform_onnx, maps, spinning=spinning, threads=settings.threads)
    passes |= {tier: _pass(avatar, maps) for tier, avatar in tiers.items() if avatar.deformer is not None}
    timings = measure(passes, runs=settings.runs, rest_s=REST_S)
    times = {name: timing.report() for name, timing in timings.items()}
    poses = measure({tier: _pose(avatar, frames) for tier, avatar in tiers.items()}, runs=settings.runs)
    errors = _errors(tiers, frames)
    return {
        "avatar": path.name,
        "gaussians": len(bundle),
        "grid": bundle.grid.size,
        "truth": next(iter(tiers)),
        "plain": {name: times[name] for name in (PLAIN, RESTING) if name in times},
        "tiers": [
            {
                "tier": tier,
                "pass": times.get(tier),
                "vertices": poses[tier].report(),
                "error": errors[tier],
            }
            for tier in tiers
        ],
    }


def _plain_pass(model: bytes, maps: list[np.ndarray], *, spinning: bool, threads: int) -> Callable[[], Any]:
    """The exported network as anyone would run it; without `spinning`, its threads do not burn the cores
    between passes.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    turn = cycle(maps)
    return lambda: session.run(["deformation"], {"offsets": next(turn)[None]})


def _pass(avatar: Avatar, maps: list[np.ndarray]) -> Callable[[], Any]:
    """A pass of the tier's network; the offsets change every time, so that none is skipped."""
    turn, deformer = cycle(maps), avatar.deformer
    return lambda: deformer(next(turn))


def _pose(avatar: Avatar, frames: list[Any]) -> Callable[[], Any]:
    turn = cycle(frames)
    return lambda: vertices_of(avatar, next(turn))


def _errors(tiers: dict[str, Avatar], frames: list[Any]) -> dict[str, dict[str, float]]:
    """Of the deformable vertices of each tier against the first one's."""
    truth: np.ndarray | None = None
    errors = {}
    for tier, avatar in tiers.items():
        deformable = avatar.bundle.grid.deformable
        found = np.stack([vertices_of(avatar, frame)[deformable] for frame in frames])
        truth = found if truth is None else truth
        errors[tier] = vertex_error_mm(found, truth)
    return errors
