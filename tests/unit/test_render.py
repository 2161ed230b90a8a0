"""The C++ renderer on scenes whose picture is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from splat_scenes import cloud, view

from cap4d import _core
from cap4d.camera import Camera
from cap4d.gaussians import Gaussians
from cap4d.render import render

SH_C0 = 0.28209479177387814


def frontal(size: int = 33, focal: float = 100.0) -> Camera:
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(K, np.eye(4), size, size)


def one(mean=(0, 0, 1), scale=0.05, opacity=0.8, color=(0.9, 0.5, 0.1)) -> Gaussians:
    sh = (np.array(color, np.float32) - 0.5)[None, None] / SH_C0
    fields = ([mean], [[1, 0, 0, 0]], [[scale] * 3], [opacity], sh)
    return Gaussians(*(np.array(x, np.float32) for x in fields))


def empty() -> Gaussians:
    return Gaussians(*(np.zeros(s, np.float32) for s in ((0, 3), (0, 4), (0, 3), (0,), (0, 16, 3))))


def concatenated(*parts: Gaussians) -> Gaussians:
    names = [f.name for f in dataclasses.fields(Gaussians)]
    return Gaussians(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def test_nothing_is_background() -> None:
    out = render(empty(), frontal(), background=(0.2, 0.4, 0.6))
    assert np.array_equal(out.rgb, np.broadcast_to(np.float32([0.2, 0.4, 0.6]), (33, 33, 3)))
    assert not out.alpha.any() and not out.depth.any()


def test_one_gaussian_has_the_analytic_profile() -> None:
    camera, gaussians = frontal(), one()
    out = render(gaussians, camera, background=(1, 1, 1))
    variance = (0.05 * 100.0) ** 2 + 0.3
    x = np.arange(33) + 0.5 - 16.5
    alpha = 0.8 * np.exp(-(x[None] ** 2 + x[:, None] ** 2) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(out.alpha, alpha, atol=1e-6)
    color = np.array([0.9, 0.5, 0.1])
    np.testing.assert_allclose(out.rgb, alpha[..., None] * color + (1 - alpha[..., None]), atol=1e-6)
    np.testing.assert_allclose(out.depth, np.where(alpha > 0, 1.0, 0), atol=2e-5)


def test_the_nearer_one_is_in_front() -> None:
    red, blue = (
        one(color=(1, 0, 0), opacity=0.9),
        one(mean=(0, 0, 1.5), scale=0.075, color=(0, 0, 1), opacity=0.9),
    )
    for pair in ((red, blue), (blue, red)):
        centre = render(concatenated(*pair), frontal(), background=None).rgb[16, 16]
        np.testing.assert_allclose(centre, [0.9, 0, 0.09], atol=1e-5)


def test_a_pixel_ends_before_its_transmittance_falls_below_1e4() -> None:
    """Alpha is clamped at 0.99 and two such leave 1e-4; at 0.98 two leave 4e-4 and the third is left out."""
    stack = [one(mean=(0, 0, 1 + 0.1 * i), scale=0.05, opacity=0.98) for i in range(3)]
    stack.append(one(mean=(0, 0, 2), opacity=0.5))
    assert render(concatenated(*stack[:2]), frontal()).alpha[16, 16] == pytest.approx(1 - 4e-4, abs=1e-6)
    assert render(concatenated(*stack), frontal()).alpha[16, 16] == pytest.approx(1 - 4e-4, abs=1e-6)
    assert render(one(opacity=1.0), frontal()).alpha[16, 16] == pytest.approx(0.99, abs=1e-6)


def test_without_a_background_colour_is_premultiplied() -> None:
    gaussians, camera = cloud(), view()
    plain, white = render(gaussians, camera, background=None), render(gaussians, camera, background=(1, 1, 1))
    np.testing.assert_allclose(plain.rgb + (1 - plain.alpha)[..., None], white.rgb, atol=1e-6)
    assert np.array_equal(plain.alpha, white.alpha)


@pytest.mark.parametrize("depth", [-1.0, 0.0, 0.0099])
def test_behind_the_near_plane_nothing_is_drawn(depth: float) -> None:
    assert not render(one(mean=(0, 0, depth)), frontal()).alpha.any()


def test_just_beyond_the_near_plane_it_is_drawn() -> None:
    assert render(one(mean=(0, 0, 0.0101), scale=1e-4), frontal()).alpha.max() > 0.5


def test_far_outside_the_image_the_jacobian_is_clamped() -> None:
    """A Gaussian beside the camera would cover everything without the clamp."""
    assert not render(one(mean=(5, 0, 0.05), scale=0.001), frontal()).alpha.any()


POISON = {
    "nan": np.nan,
    "inf": np.inf,
    "minus_inf": -np.inf,
}


@pytest.mark.parametrize("value", POISON.values(), ids=POISON)
@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh"])
def test_a_poisoned_gaussian_is_left_out(field: str, value: float) -> None:
    gaussians, camera = cloud(50), view()
    bad = getattr(gaussians, field).copy()
    bad.reshape(50, -1)[7, -1] = value
    poisoned = dataclasses.replace(gaussians, **{field: bad})
    names = [f.name for f in dataclasses.fields(Gaussians)]
    without = Gaussians(*(np.delete(getattr(gaussians, n), 7, 0) for n in names))
    a, b = render(poisoned, camera), render(without, camera)
    assert np.array_equal(a.rgb, b.rgb) and np.array_equal(a.depth, b.depth)


EXTREMES = {
    "zero_quat": {"quats": (0, 0, 0, 0)},
    "tiny_quat": {"quats": (1e-40, 0, 0, 0)},
    "huge_quat": {"quats": (3e38, 3e38, -3e38, 3e38)},
    "zero_scale": {"scales": (0, 0, 0)},
    "needle": {"scales": (1e3, 1e-20, 1e-20)},
    "huge_scale": {"scales": (1e15, 1e15, 1e15)},
    "overflowing_scale": {"scales": (3e38, 3e38, 3e38)},
    "far": {"means": (1e30, 1e30, 1e30)},
    "opacity_above_1": {"opacities": 50.0},
    "negative_opacity": {"opacities": -3.0},
    "huge_sh": {"sh": 1e30},
}


@pytest.mark.parametrize("change", EXTREMES.values(), ids=EXTREMES)
def test_extreme_gaussians_stay_finite(change: dict) -> None:
    gaussians, camera = cloud(50), view()
    for field, value in change.items():
        changed = getattr(gaussians, field).copy()
        changed[7] = value
        gaussians = dataclasses.replace(gaussians, **{field: changed})
    out = render(gaussians, camera)
    assert np.isfinite(out.rgb).all() and np.isfinite(out.depth).all()
    assert (out.alpha >= 0).all() and (out.alpha <= 1).all()


def test_a_scale_of_zero_is_a_dot_of_the_low_pass() -> None:
    alpha = render(one(scale=0.0), frontal()).alpha
    assert alpha[16, 16] == pytest.approx(0.8, abs=1e-6)
    assert alpha[16, 17] == pytest.approx(0.8 * np.exp(-1 / 0.6), abs=1e-6)


def test_what_does_not_fit_is_refused() -> None:
    g, c = cloud(5), view()
    fields = (g.means, g.quats, g.scales, g.opacities, g.sh)
    with pytest.raises(ValueError, match=r"quats: expected \[5, 4\], got \[4, 4\]"):
        _core.render(g.means, g.quats[:4], *fields[2:], c.viewmat, c.K, 8, 8)
    with pytest.raises(ValueError, match="size: expected 1 to 16384"):
        _core.render(*fields, c.viewmat, c.K, 0, 8)
    with pytest.raises(ValueError, match="sh_degree"):
        _core.render(*fields, c.viewmat, c.K, 8, 8, None, 4)
    with pytest.raises(ValueError, match="focal"):
        _core.render(*fields, c.viewmat, -c.K, 8, 8)
    with pytest.raises(TypeError):
        _core.render(g.means.astype(np.float64), *fields[1:], c.viewmat, c.K, 8, 8)
