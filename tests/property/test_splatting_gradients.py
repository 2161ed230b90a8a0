"""The reference's gradients against finite differences in double, and what must hold for any Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from parity import tolerances as tol
from splat_scenes import cloud, view

from cap4d.gaussians import Gaussians
from cap4d.raster import rasterize
from cap4d.raster.reference import rasterize_reference
from cap4d.render import render

FIELDS = ("means", "quats", "scales", "opacities", "sh")


def inputs(count: int, **options: float) -> list[torch.Tensor]:
    gaussians = cloud(count, **options)
    return [torch.from_numpy(getattr(gaussians, name)).double().requires_grad_() for name in FIELDS]


def picture(*gaussians: torch.Tensor, smooth: float) -> torch.Tensor:
    camera = view(14, 11)
    degree = int(gaussians[4].shape[1] ** 0.5) - 1
    out = rasterize_reference(
        *gaussians, camera=camera, background=(0.9, 0.4, 0.1), sh_degree=degree, smooth_cutoff=smooth
    )
    return torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], -1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reference_gradients_through_a_smooth_cutoff(degree: int) -> None:
    weights = torch.rand(11, 14, 5, generator=torch.Generator().manual_seed(2)).double() - 0.4
    gaussians = inputs(6, seed=degree, degree=degree, size=0.04)

    def loss(*g: torch.Tensor) -> torch.Tensor:
        return (picture(*g, smooth=0.3) * weights).sum()

    assert torch.autograd.gradcheck(
        loss, gaussians, eps=1e-6, atol=1e-7, rtol=tol.FINITE_DIFFERENCE, check_undefined_grad=False
    )


@pytest.mark.parametrize("seed", range(4))
def test_reference_gradients_away_from_flips(seed: int) -> None:
    """Along random directions; pixels that a step of either sign flips are left out."""
    gaussians = inputs(12, seed=seed, size=0.03)
    generator = torch.Generator().manual_seed(seed)
    for i in range(5):
        step = torch.zeros(5).index_fill_(0, torch.tensor(i), 1e-7)
        directions = [
            s * torch.randn(g.shape, generator=generator).double()
            for s, g in zip(step, gaussians, strict=True)
        ]
        plus, minus = (
            picture(*(g.detach() + sign * d for g, d in zip(gaussians, directions, strict=True)), smooth=0)
            for sign in (1, -1)
        )
        smooth = ((plus - minus).abs() < 1e-4).all(-1, keepdim=True)
        assert smooth.float().mean() > 0.9
        centre = picture(*gaussians, smooth=0) * smooth
        grads = torch.autograd.grad(centre.sum(), gaussians, allow_unused=True)
        expected = ((plus - minus) * smooth).sum() / 2
        got = sum((g * d).sum() for g, d in zip(grads, directions, strict=True))
        assert abs(got - expected) <= tol.FINITE_DIFFERENCE * abs(expected) + 1e-12


POISON = [np.nan, np.inf, -np.inf]
EXTREME = [0.0, -0.0, 1e-45, 1e-38, -1e-20, 1e-12, 1e12, -1e20, 3e38]


@settings(max_examples=150, deadline=None)
@given(
    field=st.sampled_from(FIELDS),
    at=st.integers(0, 10_000),
    value=st.sampled_from(POISON + EXTREME),
    whole=st.booleans(),
)
def test_no_number_spreads(field: str, at: int, value: float, whole: bool) -> None:
    """One bad number leaves picture and gradients finite; a non-finite one takes only its Gaussian."""
    gaussians, camera = cloud(20), view(33, 29)
    arrays = {name: getattr(gaussians, name).copy() for name in FIELDS}
    victim = at % 20
    row = arrays[field].reshape(20, -1)[victim]
    row[slice(None) if whole else at % len(row)] = value
    inputs = [torch.from_numpy(arrays[name]).requires_grad_() for name in FIELDS]
    out = rasterize(*inputs, camera=camera, background=(1, 1, 1))
    assert torch.isfinite(out.rgb).all() and torch.isfinite(out.depth).all()
    assert ((out.alpha >= 0) & (out.alpha <= 1)).all()
    (out.rgb.sum() + out.alpha.sum() + out.depth.sum()).backward()
    for name, x in zip(FIELDS, inputs, strict=True):
        assert torch.isfinite(x.grad).all(), name
    if not np.isfinite(value):
        others = [np.delete(arrays[name], victim, 0) for name in FIELDS]
        without = render(Gaussians(*others), camera)
        assert np.array_equal(without.rgb, out.rgb.detach().numpy())
        assert out.radii[victim] == 0
        assert not any(x.grad[victim].any() for x in inputs)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_the_order_of_the_input_does_not_matter(seed: int) -> None:
    gaussians, camera = cloud(60, seed=seed), view(40, 30)
    order = np.random.default_rng(seed).permutation(60)
    shuffled = Gaussians(*(np.ascontiguousarray(getattr(gaussians, n)[order]) for n in FIELDS))
    assert np.array_equal(render(gaussians, camera).rgb, render(shuffled, camera).rgb)


@settings(max_examples=20, deadline=None)
@given(factor=st.floats(1e-6, 1e6), sign=st.sampled_from([1, -1]))
def test_the_norm_of_a_quaternion_does_not_matter(factor: float, sign: int) -> None:
    gaussians, camera = cloud(60), view(40, 30)
    quats = (gaussians.quats * np.float32(sign * factor)).astype(np.float32)
    scaled = Gaussians(gaussians.means, quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    error = np.abs(render(gaussians, camera).rgb - render(scaled, camera).rgb)
    assert (error > 1e-5).mean() <= tol.FLIP_SHARE
