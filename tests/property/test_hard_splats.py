"""Splatting at the edge of float32, forward and backward, against the float64 reference; and no numbers.

`test_hard_isas.py` runs this file on each instruction set; `parity/tolerances.py` has the bounds and why.
"""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch
from hard_splats import SCENES, Scene, frontal, gaussians, in_front, scene_around
from hypothesis import given, settings
from hypothesis import strategies as st
from parity import tolerances as tol
from parity.test_splatting import BACKGROUND, FIELDS, leaves, near_flip
from splat_scenes import cloud, view

from cap4d import _core
from cap4d.camera import NEAR, Camera
from cap4d.gaussians import Gaussians
from cap4d.raster import Rasterized, rasterize, reference
from cap4d.raster.reference import rasterize_reference
from cap4d.render import render

OUTPUTS = ("rgb", "alpha", "depth")
GRADIENTS = (*FIELDS, "means2d")

SIZES = (0, 1e-45, 1e-40, 1.2e-38, 1e-20, 1e-12, 1e-6, 1, 1e4, 1e9, 1e19, 1e30, 3.4e38, np.inf)
POISON = np.float32([sign * size for size in SIZES for sign in (1, -1)] + [np.nan])
"""Zeros, denormals, the smallest and the largest numbers, and none, of both signs."""


def units(scene: Scene, drawn: Rasterized) -> np.ndarray:
    """[H, W, 5] by which rgb, alpha and depth are divided: colours beyond 1 and depths beyond 1 m are rounded
    in proportion.
    """
    color = max(1.0, float(drawn.rgb.detach().abs().max()))
    depth = max(1.0, float(drawn.depth.detach().abs().max()))
    return np.array([color] * 3 + [1.0, depth])


def maps(drawn: Rasterized) -> torch.Tensor:
    """[H, W, 5]"""
    return torch.cat([drawn.rgb, drawn.alpha[..., None], drawn.depth[..., None]], -1)


def worst(a: torch.Tensor, b: torch.Tensor) -> tuple[float, float]:
    """How far gradient `a` is from `b`: of its norm, and in one element (with the floor of the table)."""
    a, b = a.double(), b.double()
    if not b.any():
        return float(a.abs().max() if len(a) else 0), 0.0
    floor = tol.GRADIENT_FLOOR * b.abs().max()
    return float((a - b).norm() / b.norm()), float(((a - b).abs() / (b.abs() + floor)).max())


def backward(inputs: list[torch.Tensor], drawn: Rasterized, weights: torch.Tensor) -> list[torch.Tensor]:
    """Gradients of GRADIENTS; zero where nothing was drawn."""
    loss = (maps(drawn) * weights).sum()
    if loss.requires_grad:
        loss.backward()
    return [torch.zeros_like(x) if x.grad is None else x.grad for x in (*inputs, drawn.means2d)]


@pytest.mark.parametrize("name", SCENES)
def test_pictures_and_gradients_agree(name: str) -> None:
    scene = SCENES[name]()
    clouds, camera = scene
    flips = near_flip(clouds, camera)
    drawn, grads = [], []
    for backend in ("cpu", "reference"):
        inputs = leaves(clouds)
        drawn.append(rasterize(*inputs, camera=camera, background=BACKGROUND, backend=backend))
        unit = units(scene, drawn[0])
        weights = torch.rand(*flips.shape, 5, generator=torch.Generator().manual_seed(1)).double() - 0.3
        weights = weights * torch.from_numpy(~flips)[..., None] / torch.from_numpy(unit)
        grads.append(backward(inputs, drawn[-1], weights))
    fast, slow = drawn
    error = ((maps(fast).double() - maps(slow)).abs().detach().numpy() / unit).max(-1)
    picture, gradient, element = tol.HARD[name]
    off = [worst(a, b) for a, b in zip(*grads, strict=True)]
    position = (fast.means2d - slow.means2d).abs().max().item()
    norms, elements = zip(*off, strict=True)
    print(
        f"{name}: {_core.isa()}, picture {error[~flips].max():.1e}, gradients {max(norms):.1e} of the norm,"
    )
    print(f"{max(elements):.1e} in an element, {position:.1e} px, {flips.mean():.1e} near a flip")
    for result in (*(getattr(fast, o) for o in OUTPUTS), *grads[0], *grads[1]):
        assert torch.isfinite(result).all()
    assert ((fast.alpha >= 0) & (fast.alpha <= 1)).all()
    assert name == "behind" or (slow.alpha > 0.1).any(), "the scene shows nothing"
    assert torch.equal(fast.radii > 0, slow.radii > 0)
    assert flips.mean() <= tol.HARD_FLIP_SHARE
    assert error[~flips].max() <= picture
    assert error.max() <= picture + 2 * tol.FLIP_SIZE
    assert position <= max(tol.MEANS2D, tol.HARD_MEANS2D * fast.means2d.abs().max().item())
    for field, (norm, one) in zip(GRADIENTS, off, strict=True):
        assert norm <= gradient, field
        assert one <= element, field


@pytest.mark.parametrize(
    "name", ["near_plane", "singular", "saturated", "opaque", "quaternions", "far_away", "covering"]
)
def test_reference_gradients_are_those_of_its_pictures(name: str) -> None:
    """Central differences in double, every field moved in proportion to itself; no pixels near a flip."""
    clouds, camera = SCENES[name]()
    inputs = [x.detach().double().requires_grad_() for x in leaves(clouds)]
    keep = torch.from_numpy(~near_flip(clouds, camera, margin=1e-3)).double()[..., None]
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(camera.height, camera.width, 5, generator=generator).double() - 0.3

    def loss(*fields: torch.Tensor) -> torch.Tensor:
        drawn = rasterize_reference(*fields, camera=camera, background=BACKGROUND, sh_degree=clouds.sh_degree)
        return (maps(drawn) * weights * keep).sum()

    grads = torch.autograd.grad(loss(*inputs), inputs, allow_unused=True)
    for i, grad in enumerate(grads):
        assert torch.isfinite(grad).all(), FIELDS[i]
        sizes = inputs[i].detach()
        if FIELDS[i] == "means":
            sizes = sizes - torch.from_numpy(camera.position)
            depths = sizes @ torch.from_numpy(camera.viewmat[2, :3])
            sizes = sizes * ((depths - NEAR).abs() > 1e-5)[:, None]  # those would cross the near plane
        step = 1e-6 * sizes * torch.randn(sizes.shape, generator=generator).double()
        with torch.no_grad():
            moved = [loss(*(x + s * step if j == i else x for j, x in enumerate(inputs))) for s in (1, -1)]
        expected, got = float(moved[0] - moved[1]) / 2, float((grad * step).sum())
        size = float((grad * step).norm())  # the terms cancel
        assert abs(got - expected) <= tol.FINITE_DIFFERENCE * (abs(expected) + size) + 1e-12, FIELDS[i]


def results(clouds: Gaussians, camera: Camera, threads: int) -> list[np.ndarray]:
    """Pictures of both passes, and gradients for weights that the picture itself decides."""
    fields = [getattr(clouds, n) for n in FIELDS]
    arguments = (camera.viewmat, camera.K, camera.width, camera.height, BACKGROUND, -1, threads)
    *image, means2d, radii, rendered = _core.rasterize(*fields, *arguments)
    v_rgb, v_alpha = np.sin(image[0] * 50), np.cos(image[1] * 50)
    grads = _core.rasterize_vjp(rendered, *fields, -1, *image, v_rgb, v_alpha, 0.1 * v_alpha, threads)
    return [*image, *_core.render(*fields, *arguments), radii, means2d, *grads]


@pytest.mark.parametrize("name", SCENES)
def test_the_same_bits_for_one_and_two_threads(name: str) -> None:
    one, two = (results(*SCENES[name](), threads) for threads in (1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(one[:3], one[3:6], strict=True)), "play and train differ"


def check_contained(clouds: Gaussians, camera: Camera, victim: int, *, must_go: bool) -> None:
    """Everything is finite; and where the victim is not drawn, all is as if it did not exist."""
    found = results(clouds, camera, 2)
    radii, grads = found[6], found[7:]
    assert all(np.isfinite(x).all() for x in found)
    assert not (must_go and radii[victim]), "drawn, though not a number"
    if not radii[victim]:
        others = Gaussians(*(np.delete(getattr(clouds, n), victim, 0) for n in FIELDS))
        without = results(others, camera, 2)
        assert all(np.array_equal(a, b) for a, b in zip(found[:6], without[:6], strict=True))
        for a, b in zip(grads, without[7:], strict=True):
            assert np.array_equal(np.delete(a, victim, 0), b)
            assert not a[victim].any()


@pytest.mark.parametrize("value", POISON, ids=str)
@pytest.mark.parametrize("field", FIELDS)
def test_no_number_spreads(field: str, value: np.float32) -> None:
    """In each component of a field, and in all of them."""
    victim = 7
    for look in (scene_around(victim), (cloud(20, seed=50), view(33, 29, yaw_deg=45.0))):
        size = getattr(look[0], field)[victim].size
        for part in (*range(size), slice(None)):
            arrays = {n: getattr(look[0], n).copy() for n in FIELDS}
            arrays[field].reshape(20, -1)[victim, part] = value
            check_contained(Gaussians(**arrays), look[1], victim, must_go=not np.isfinite(value))


CAMERAS = [
    view(33, 29, yaw_deg=45.0),
    frontal(33, 29, focal=70.0),
    frontal(20, 20, focal=3e5),
    frontal(20, 20, focal=0.5),
    frontal(20, 20, focal=20.0, x=-1e4, y=300.0),
]


@settings(max_examples=400, deadline=None)
@given(
    camera=st.sampled_from(CAMERAS),
    seed=st.integers(0, 10**6),
    poisons=st.lists(
        st.tuples(
            st.sampled_from(FIELDS), st.integers(0, 48), st.sampled_from(POISON.tolist()), st.booleans()
        ),
        min_size=1,
        max_size=4,
    ),
)
def test_no_numbers_together_spread(
    camera: Camera, seed: int, poisons: list[tuple[str, int, float, bool]]
) -> None:
    """Several fields of one Gaussian at once, set or multiplied."""
    clouds = cloud(12, seed=seed)
    arrays = {n: getattr(clouds, n).copy() for n in FIELDS}
    if camera.viewmat[2, 3] == 0:
        arrays["means"] = arrays["means"] * np.float32(0.3) + np.float32([0, 0, 1])
    for field, part, value, scale in poisons:
        row = arrays[field].reshape(12, -1)[5]
        at = slice(None) if part == 48 else part % len(row)
        with np.errstate(all="ignore"):
            row[at] = row[at] * np.float32(value) if scale else value
    must_go = not all(np.isfinite(arrays[n][5]).all() for n in FIELDS)
    check_contained(Gaussians(**arrays), camera, 5, must_go=must_go)


def test_the_near_plane_is_sharp() -> None:
    near = np.float32(0.01)
    steps = (np.nextafter(near, np.float32(0)), near, np.nextafter(near, np.float32(1)))
    for z, drawn in zip(steps, (False, True, True), strict=True):
        one = gaussians(means=[0, 0, 1], quats=[1, 0, 0, 0], scales=1e-3, opacities=0.9, sh=[[1.0] * 3])
        one = Gaussians(np.float32([[0, 0, z]]), one.quats, one.scales, one.opacities, one.sh)
        assert render(one, frontal()).alpha.any() == drawn


def test_layers_at_one_depth_come_in_the_order_given() -> None:
    """A thousand at one place: the picture is the recurrence, in that order, in double."""
    rng = np.random.default_rng(52)
    opacities, colors = rng.uniform(0.004, 0.009, 1000), rng.uniform(0, 1, (1000, 3))
    same = dict(means=np.tile([0, 0, 1.0], (1000, 1)), quats=[1, 0, 0, 0], scales=10.0)
    camera = frontal(1, 1)
    for order in (np.arange(1000), np.arange(1000)[::-1]):
        sh = (colors[order, None] - 0.5) / 0.28209479177387814
        clouds = gaussians(**same, opacities=opacities[order], sh=sh)
        alphas = clouds.opacities.astype(np.float64)
        weights = alphas * np.concatenate([[1], np.cumprod(1 - alphas)[:-1]])
        got = render(clouds, camera, background=(0, 0, 0)).rgb[0, 0]
        np.testing.assert_allclose(got, weights @ colors[order], atol=tol.HARD["layers"][0])


def test_depths_far_from_the_origin_are_in_order() -> None:
    """10 km away and as little as 5 um apart, seen along no axis; the same for one and two threads."""
    clouds, camera = SCENES["far_away"]()
    viewmat = camera.viewmat.astype(np.float32)
    depths = clouds.means.astype(np.float64) @ viewmat[2, :3].astype(np.float64)
    orders = [_core.sort_by_depth(clouds.means, viewmat, threads) for threads in (1, 2)]
    assert np.array_equal(*orders)
    assert (np.diff(depths[orders[0]]) >= 0).all()


def test_no_gaussians_are_the_background() -> None:
    clouds = Gaussians(*(getattr(cloud(2), n)[:0] for n in FIELDS))
    found = results(clouds, frontal(5, 4), 2)
    assert np.array_equal(found[0], np.broadcast_to(np.float32(BACKGROUND), (4, 5, 3)))
    assert not found[1].any() and not found[2].any() and all(len(x) == 0 for x in found[6:])


def test_an_image_of_8192_px_a_side() -> None:
    """Forward only, in 1.3 GB: the strips above have the gradients. Its windows are the reference's."""
    clouds, camera = gaussians(**in_front(40, seed=53, spread=0.25)), frontal(8192, 8192, focal=8192.0)
    drawn = render(clouds, camera, background=None)
    fields = [torch.from_numpy(getattr(clouds, n)).double() for n in FIELDS]
    colors = reference.eval_sh(fields[4], fields[0], clouds.sh_degree)
    assert reference.drawable(*fields[:4], colors, camera).all()
    p = reference.project(*fields[:4], camera=camera)
    corners = (p.means2d.numpy().round().astype(int) - 8).clip(0, 8176)
    off = []
    for x, y in [*corners[::5], (0, 0), (8176, 8176)]:
        rgb, alpha, depth = reference.composite(
            p.means2d - torch.tensor([x, y]),
            p.conics,
            fields[3][p.ids],
            colors[p.ids].clamp(min=0),
            p.depths,
            camera=frontal(16, 16),
        )
        window = (slice(y, y + 16), slice(x, x + 16))
        off.append(np.abs(drawn.rgb[window] - rgb.numpy()).max(-1))
        off.append(np.abs(drawn.alpha[window] - alpha.numpy()))
        off.append(np.abs(drawn.depth[window] * drawn.alpha[window] - depth.numpy()))
    off = np.array(off)
    assert drawn.alpha.max() > 0.5
    assert (off > tol.HARD["wide_8192"][0]).mean() <= tol.HARD_FLIP_SHARE
    assert off.max() <= 2 * tol.FLIP_SIZE
    assert all(np.isfinite(getattr(drawn, o)).all() for o in OUTPUTS)


BAD_CAMERAS = {
    "viewmat: expected finite": lambda v, k: v.__setitem__((1, 1), np.nan),
    "viewmat: expected finite numbers": lambda v, k: v.__setitem__((0, 3), np.inf),
    "K: expected finite numbers": lambda v, k: k.__setitem__((0, 2), np.inf),
    "K: expected positive focal lengths": lambda v, k: k.__setitem__((1, 1), 0),
}


@pytest.mark.parametrize("message", BAD_CAMERAS)
def test_a_camera_of_no_numbers_is_refused(message: str) -> None:
    clouds, camera = cloud(5), view(8, 8)
    viewmat, K = camera.viewmat.copy(), camera.K.copy()
    BAD_CAMERAS[message](viewmat, K)
    with pytest.raises(ValueError, match=message):
        _core.render(*(getattr(clouds, n) for n in FIELDS), viewmat, K, 8, 8)


@settings(max_examples=100, deadline=None)
@given(
    focal=st.sampled_from([1e-300, 1e-45, 1e-10, 1.0, 1e10, 1e38, 1e300]),
    middle=st.sampled_from([0.0, -1e4, 1e9, -1e30, 1e300]),
    shift=st.sampled_from([0.0, -1e7, 1e20, 1e300]),
)
def test_any_camera_of_numbers_gives_numbers(focal: float, middle: float, shift: float) -> None:
    viewmat, K = view(20, 20).viewmat.copy(), np.array([[focal, 0, middle], [0, focal, 10], [0, 0, 1]])
    viewmat[1, 3] += shift
    assert all(np.isfinite(x).all() for x in results(cloud(20), Camera(K, viewmat, 20, 20), 1))


def test_this_is_the_instruction_set_asked_for() -> None:
    wanted = os.environ.get("CAP4D_ISA")
    if wanted and _core.isa() != wanted:
        pytest.skip(f"this processor does not run {wanted}, but {_core.isa()}")
