"""One optimiser step of fitting: Adam on everything that a cloud of Gaussians is made of, beside torch's
own.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from cap4d import _core
from cap4d.evaluate.bench.ceilings import Ceilings
from cap4d.evaluate.bench.floor import adam_floor_ms
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.timing import measure

GAUSSIANS = 100_000
SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (16, 3)}
RATE = 1e-3
REST_S = 0.02  # torch's threads spin for a while after their work
TORCH, FUSED, OURS = "torch.optim.Adam", "torch.optim.Adam(fused=True)", "cap4d, fused"


def measure_fitting(settings: Settings, ceilings: Ceilings) -> dict[str, Any]:
    """Times of a step in each of the ways that are there; `not_measured` says what is missing."""
    count = GAUSSIANS // 100 if settings.quick else GAUSSIANS
    values = count * sum(int(np.prod(shape)) for shape in SHAPES.values())
    calls: dict[str, Callable[[], Any]] = {}
    missing = []
    try:
        calls = torch_steps(count, threads=settings.threads)
    except ModuleNotFoundError as error:
        missing.append(f"torch.optim.Adam: needs the package {error.name}")
    if not hasattr(_core, "adam_step"):
        missing.append("our fused Adam: this build of _core has none")
    timings = measure(calls, runs=settings.short_runs, rest_s=REST_S)
    return {
        "gaussians": count,
        "values": values,
        "floor_ms": round(adam_floor_ms(values, ceilings), 3),
        "steps": [{"name": name, **timing.report()} for name, timing in timings.items()],
        "not_measured": missing,
    }


def torch_steps(count: int, *, threads: int) -> dict[str, Callable[[], Any]]:
    """torch's steps: the kind one gets without asking, and its fused one.

    Raises:
        ModuleNotFoundError: torch is not installed.
    """
    torch = importlib.import_module("torch")
    torch.set_num_threads(threads)
    steps = {}
    for name, options in ((TORCH, {}), (FUSED, {"fused": True})):
        values, grads = (random_fields(count, seed=seed) for seed in (0, 1))
        parameters = [torch.from_numpy(value).requires_grad_() for value in values.values()]
        for parameter, grad in zip(parameters, grads.values(), strict=True):
            parameter.grad = torch.from_numpy(grad)
        steps[name] = torch.optim.Adam(parameters, lr=RATE, **options).step
    return steps


def random_fields(count: int, *, seed: int) -> dict[str, np.ndarray]:
    """float32 arrays of the shapes of `SHAPES`."""
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=(count, *shape)).astype(np.float32) for name, shape in SHAPES.items()}
