"""One optimiser step of fitting: Adam on all that a cloud of Gaussians is made of, beside torch's own."""

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
RATE, BETAS, EPSILON = 1e-3, (0.9, 0.999), 1e-8
REST_S = 0.05  # torch's threads spin for a while after their work
STEPS = 10  # after which the parameters are compared
TORCH, FUSED, OURS = "torch.optim.Adam", "torch.optim.Adam(fused=True)", "cap4d, fused"

Fields = dict[str, np.ndarray]
Step = Callable[[], Any]


def measure_fitting(settings: Settings, ceilings: Ceilings) -> dict[str, Any]:
    """Times of a step of each kind, and how far from torch's each is after some."""
    count = GAUSSIANS // 100 if settings.quick else GAUSSIANS
    values = count * sum(int(np.prod(shape)) for shape in SHAPES.values())
    steps, missing = {}, []
    if hasattr(_core, "adam_step"):
        steps[OURS] = our_step
    else:
        missing.append("our fused Adam: this build of _core has none")
    try:
        importlib.import_module("torch")
        steps |= {TORCH: torch_step, FUSED: fused_step}
    except ModuleNotFoundError as error:
        missing.append(f"torch.optim.Adam: needs the package {error.name}")
    parameters = {name: random_fields(count, seed=0) for name in steps}
    gradients = random_fields(count, seed=1)
    calls = {
        name: make(parameters[name], gradients, threads=settings.threads) for name, make in steps.items()
    }
    differences = after_steps(calls, parameters)
    timings = measure(calls, runs=settings.short_runs, rest_s=REST_S)
    return {
        "gaussians": count,
        "values": values,
        "floor_ms": round(adam_floor_ms(values, ceilings), 3),
        "steps": [
            {"name": name, **timing.report(), "difference": differences.get(name)}
            for name, timing in timings.items()
        ],
        "not_measured": missing,
    }


def after_steps(calls: dict[str, Step], parameters: dict[str, Fields]) -> dict[str, float]:
    """Largest difference of any parameter from torch's plain Adam after `STEPS` steps; none without torch."""
    for call in calls.values():
        for _ in range(STEPS):
            call()
    if TORCH not in parameters:
        return {}
    return {
        name: max(float(np.abs(field - parameters[TORCH][key]).max()) for key, field in fields.items())
        for name, fields in parameters.items()
    }


def our_step(parameters: Fields, gradients: Fields, *, threads: int) -> Step:
    """Ours, as `avatar.adam` calls it."""
    moments = {name: [np.zeros_like(field) for _ in range(2)] for name, field in parameters.items()}
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        for name, field in parameters.items():
            how = (RATE, *BETAS, EPSILON, 0.0, done, threads)
            _core.adam_step(field, gradients[name], *moments[name], *how)

    return step


def torch_step(parameters: Fields, gradients: Fields, *, threads: int, **options: bool) -> Step:
    """torch's, the kind that one gets without asking. It writes to the arrays themselves."""
    torch = importlib.import_module("torch")
    torch.set_num_threads(threads)
    tensors = [torch.from_numpy(field).requires_grad_() for field in parameters.values()]
    for tensor, name in zip(tensors, parameters, strict=True):
        tensor.grad = torch.from_numpy(gradients[name])
    return torch.optim.Adam(tensors, lr=RATE, betas=BETAS, eps=EPSILON, **options).step


def fused_step(parameters: Fields, gradients: Fields, *, threads: int) -> Step:
    """torch's fused one."""
    return torch_step(parameters, gradients, threads=threads, fused=True)


def random_fields(count: int, *, seed: int) -> Fields:
    """float32 arrays of the shapes of `SHAPES`."""
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=(count, *shape)).astype(np.float32) for name, shape in SHAPES.items()}
