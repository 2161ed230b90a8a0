"""The C++ renderer against the readable reference: pictures and gradients, on each instruction set."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from parity import tolerances as tol
from splat_scenes import SCENES, cloud, view

from cap4d import _core
from cap4d.camera import Camera
from cap4d.gaussians import Gaussians
from cap4d.raster import Rasterized, rasterize, reference

BACKGROUND = (1.0, 0.5, 0.2)
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def leaves(gaussians: Gaussians) -> list[torch.Tensor]:
    return [torch.from_numpy(getattr(gaussians, name)).clone().requires_grad_() for name in FIELDS]


def near_flip(gaussians: Gaussians, camera: Camera, *, margin: float = tol.FLIP_MARGIN) -> np.ndarray:
    """bool[H, W]: pixels where float32 may decide otherwise than float64."""
    means, quats, scales, opacities, sh = (torch.from_numpy(getattr(gaussians, n)).double() for n in FIELDS)
    keep = reference.drawable(means, quats, scales, opacities, sh[:, 0], camera)
    means, quats, scales, opacities = (x[keep] for x in (means, quats, scales, opacities))
    p = reference.project(means, quats, scales, opacities, camera=camera)
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2).double() + 0.5
    dx, dy = (pixels[:, None] - p.means2d).unbind(-1)
    a, b, c = p.conics.unbind(1)
    raw = opacities[p.ids] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
    alphas = reference.pixel_alphas(p.means2d, p.conics, opacities[p.ids], pixels)
    through = torch.cumprod(1 - alphas, 1)
    faint = ((raw / reference.ALPHA_MIN - 1).abs() < margin).any(1)
    ending = ((through / reference.TRANSMITTANCE_MIN - 1).abs() < margin).any(1)
    return (faint | ending).reshape(camera.height, camera.width).numpy()


def difference(a: Rasterized, b: Rasterized) -> np.ndarray:
    """[H, W] largest absolute difference of colour, alpha and depth."""
    maps = [(getattr(a, n).double() - getattr(b, n)).abs() for n in ("rgb", "alpha", "depth")]
    return torch.stack([maps[0].amax(-1), *maps[1:]]).amax(0).detach().numpy()


@pytest.mark.parametrize("name", SCENES)
def test_pictures_agree(name: str) -> None:
    gaussians, camera = SCENES[name]()
    inputs = [torch.from_numpy(getattr(gaussians, n)) for n in FIELDS]
    fast, slow = (
        rasterize(*inputs, camera=camera, background=BACKGROUND, backend=b) for b in ("cpu", "reference")
    )
    flips = near_flip(gaussians, camera)
    error = difference(fast, slow)
    print(f"{name}: {flips.sum()} of {flips.size} pixels near a flip, {(error > tol.RGB).sum()} flipped")
    assert slow.alpha.max() > 0.1, "the scene shows nothing"
    assert flips.mean() <= tol.FLIP_SHARE
    assert error[~flips].max() <= min(tol.RGB, tol.ALPHA, tol.DEPTH)
    assert error.max() <= tol.FLIP_SIZE * 2
    assert torch.equal(fast.radii > 0, slow.radii > 0)
    assert (fast.radii - slow.radii).abs().max() <= 1  # rounded up
    assert (fast.means2d - slow.means2d).abs().max() <= tol.MEANS2D


@pytest.mark.parametrize("name", SCENES)
def test_gradients_agree(name: str) -> None:
    gaussians, camera = SCENES[name]()
    weights = torch.rand(camera.height, camera.width, 5, generator=torch.Generator().manual_seed(1)) - 0.3
    weights = weights.double() * torch.from_numpy(~near_flip(gaussians, camera))[..., None]
    grads = []
    for backend in ("cpu", "reference"):
        inputs = leaves(gaussians)
        out = rasterize(*inputs, camera=camera, background=BACKGROUND, backend=backend)
        (torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], -1) * weights).sum().backward()
        grads.append([*(x.grad for x in inputs), out.means2d.grad])
    for field, fast, slow in zip((*FIELDS, "means2d"), *grads, strict=True):
        fast, slow = fast.double(), slow.double()
        assert slow.abs().max() > 0 or name == "one_pixel", field
        norm = (fast - slow).norm() / slow.norm()
        element = ((fast - slow).abs() / (slow.abs() + tol.GRADIENT_FLOOR * slow.abs().max())).max()
        assert norm <= tol.GRADIENT, f"{field}: {norm:.2e} of the norm"
        assert element <= tol.GRADIENT, f"{field}: {element:.2e} in one element"


def test_only_the_outputs_used_give_gradients() -> None:
    gaussians, camera = cloud(), view()
    for weigh in (lambda r: r.alpha.sum(), lambda r: r.depth.sum(), lambda r: r.rgb.sum()):
        grads = []
        for backend in ("cpu", "reference"):
            inputs = leaves(gaussians)
            weigh(rasterize(*inputs, camera=camera, background=BACKGROUND, backend=backend)).backward()
            grads.append(torch.cat([x.grad.flatten().double() for x in inputs[:4]]))
        assert (grads[0] - grads[1]).norm() <= 0.02 * grads[1].norm()  # flips are not masked here


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_lower_degree_ignores_the_higher_coefficients(degree: int) -> None:
    gaussians, camera = cloud(), view()
    used = (degree + 1) ** 2
    inputs, short = leaves(gaussians), leaves(gaussians)
    short[4] = short[4].detach()[:, :used].clone().requires_grad_()
    a = rasterize(*inputs, camera=camera, sh_degree=degree)
    b = rasterize(*short, camera=camera)
    assert torch.equal(a.rgb, b.rgb)
    a.rgb.sum().backward(), b.rgb.sum().backward()
    assert torch.equal(inputs[4].grad[:, :used], short[4].grad)
    assert not inputs[4].grad[:, used:].any()
    assert torch.equal(inputs[0].grad, short[0].grad)


CHILD = """
import sys, numpy as np
sys.path[:0] = sys.argv[2:]
from splat_scenes import SCENES
from cap4d import _core
out = {"isa": _core.isa()}
for name in ("mixed", "solid", "fine", "needles"):
    g, c = SCENES[name]()
    f = (g.means, g.quats, g.scales, g.opacities, g.sh)
    rgb, alpha, depth, _, _, rendered = _core.rasterize(*f, c.viewmat, c.K, c.width, c.height, None, -1, 2)
    grads = _core.rasterize_vjp(rendered, *f, -1, rgb, alpha, depth, np.cos(rgb * 9), None, None, 2)
    for key, value in zip(("rgb", "means", "quats", "scales", "opacities", "sh", "means2d"), (rgb, *grads)):
        out[f"{name}_{key}"] = value
np.savez(sys.argv[1], **out)
"""


def results_of(isa: str, folder: Path) -> dict[str, np.ndarray]:
    """Pictures and gradients of CHILD's scenes by one instruction set; "isa" is the one that did run."""
    path = folder / f"{isa}.npz"
    command = [sys.executable, "-c", CHILD, str(path), str(Path(__file__).resolve().parents[1])]
    subprocess.run(command, env=os.environ | {"CAP4D_ISA": isa}, check=True)
    with np.load(path) as results:
        return dict(results)


@pytest.fixture(scope="module")
def base_results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    return results_of("base", tmp_path_factory.mktemp("isa"))


@pytest.mark.parametrize("isa", ["v3", "v4"])
def test_instruction_sets_agree(isa: str, base_results: dict[str, np.ndarray], tmp_path: Path) -> None:
    results = results_of(isa, tmp_path)
    assert base_results["isa"] == "base"
    if results["isa"] != isa:
        pytest.skip(f"this processor does not run {isa}, but {results['isa']}")
    for key in sorted(set(results) - {"isa"}):
        a, b = base_results[key], results[key]
        assert np.isfinite(a).all() and np.isfinite(b).all(), key
        picture = key.endswith("rgb")
        scale = 1.0 if picture else 100 * max(1.0, np.linalg.norm(a) / np.sqrt(a.size))
        error = np.abs(a - b)
        print(f"{key}: {isa} off by {error.max() / (1 if picture else np.abs(a).max()):.1e}", end=" ")
        print(f"at most, {(error > tol.ISA * scale).mean():.1e} of elements flipped")
        assert (error > tol.ISA * scale).mean() <= tol.FLIP_SHARE, key
        assert error.max() <= (tol.FLIP_SIZE * 2 if picture else tol.ISA_GRADIENT * np.abs(a).max()), key


def test_an_unknown_instruction_set_is_refused() -> None:
    command = [sys.executable, "-c", "from cap4d import _core; _core.isa()"]
    run = subprocess.run(command, env=os.environ | {"CAP4D_ISA": "v5"}, capture_output=True, text=True)
    assert run.returncode == 1
    assert run.stderr.splitlines()[-1] == "ValueError: CAP4D_ISA: expected base|v3|v4|vnni, got v5"


CROWD = """
import os, sys
sys.path[:0] = sys.argv[1:]
from splat_scenes import needles
from cap4d import _core
g, c = needles()
before = len(os.listdir("/proc/self/task"))
f = (g.means, g.quats, g.scales, g.opacities, g.sh)
_core.render(*f, c.viewmat, c.K, c.width, c.height, None, -1, 99_999)
print(len(os.listdir("/proc/self/task")) - before)
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="no /proc to count threads in")
def test_no_more_than_256_threads_whatever_is_asked() -> None:
    command = [sys.executable, "-c", CROWD, str(Path(__file__).resolve().parents[1])]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    assert int(run.stdout) == 255  # and the caller, for 1024 tiles


@pytest.mark.parametrize("name", ["mixed", "solid", "wide", "many", "needles"])
def test_the_same_bits_for_any_number_of_threads(name: str) -> None:
    gaussians, camera = SCENES[name]()
    fields = [getattr(gaussians, n) for n in FIELDS]
    view_args = (camera.viewmat, camera.K, camera.width, camera.height, BACKGROUND, -1)
    results = []
    for threads in (1, 2, 3, 8):
        *image, means2d, radii, rendered = _core.rasterize(*fields, *view_args, threads)
        v_rgb, v_map = np.sin(image[0] * 50), np.sin(image[1] * 50)
        grads = _core.rasterize_vjp(rendered, *fields, -1, *image, v_rgb, v_map, v_map, threads)
        play = _core.render(*fields, *view_args, threads)
        results.append([x.tobytes() for x in (*image, means2d, radii, *grads, *play)])
    assert all(r == results[0] for r in results)
    assert results[0][:3] == results[0][-3:], "play and train differ"
