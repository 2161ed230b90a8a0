"""How long splatting takes on the standard scenes, forward and backward, and whether the picture is right.

    python -m pytest -m bench -s tests/bench/bench_splatting.py

Milliseconds are the least of several runs on all cores. A window is checked against the float64 reference.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from cap4d import _core
from cap4d.camera import Camera
from cap4d.gaussians import Gaussians
from cap4d.raster import rasterize

pytestmark = pytest.mark.bench
RUNS = 9
SEED = 20240611
WINDOW = 24  # px a side
SCENES = {
    "fit": ("make_head", 60_000, 256),
    "head_30k": ("make_head", 30_000, 512),
    "head_100k": ("make_head", 100_000, 512),
    "head_300k": ("make_head", 300_000, 512),
    "bad_100k": ("make_bad", 100_000, 512),
}


@pytest.fixture(scope="module")
def maker(shared: Path) -> ModuleType:
    path = shared / "scenes" / "make_scene.py"
    if not path.is_file():
        pytest.skip(f"no {path}")
    spec = importlib.util.spec_from_file_location("make_scene", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def scene(maker: ModuleType, kind: str, count: int, size: int) -> tuple[Gaussians, Camera]:
    means, quats, scales, opacities, dc, rest = getattr(maker, kind)(count, SEED)
    sh = np.concatenate([dc[:, None], rest], 1)
    fields = (np.ascontiguousarray(x, np.float32) for x in (means, quats, scales, opacities, sh))
    focal = 0.5 * size / np.tan(np.radians(maker.FOVY) / 2)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Gaussians(*fields), Camera(K, maker.look(0), size, size)


def least_ms(call: Callable[[], object]) -> float:
    call()
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


@pytest.mark.parametrize("name", SCENES)
def test_splatting(maker: ModuleType, name: str) -> None:
    gaussians, camera = scene(maker, *SCENES[name])
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    where = (camera.viewmat, camera.K, camera.width, camera.height, (1.0, 1.0, 1.0))
    *image, _, _, rendered = _core.rasterize(*fields, *where)
    v_rgb = np.random.default_rng(0).normal(size=image[0].shape).astype(np.float32)
    play = least_ms(lambda: _core.render(*fields, *where))
    train = least_ms(lambda: _core.rasterize(*fields, *where))
    back = least_ms(lambda: _core.rasterize_vjp(rendered, *fields, -1, *image, v_rgb, None, None))
    machine = f"{_core.isa()}, {_core.default_threads()} threads"
    print(f"\n{name:10s} {machine}, {rendered.pairs} pairs: play {play:.1f} ms", end=", ")
    print(f"train forward {train:.1f} + backward {back:.1f} = {train + back:.1f} ms")
    middle = camera.width // 2 - WINDOW // 2
    window = camera.cropped(middle, middle, WINDOW, WINDOW)
    near = np.abs(camera.project(gaussians.means)[:, :2] - camera.width / 2).max(1) < WINDOW * 1.5
    part = [torch.from_numpy(f[near][:4000]) for f in fields]
    fast, slow = (rasterize(*part, camera=window, backend=b).rgb.double() for b in ("cpu", "reference"))
    assert ((fast - slow).abs() > 1e-4).double().mean() < 0.01
    assert np.isfinite(image[0]).all() and image[1].max() > 0.9
