"""The torch entry point: what goes in, what comes out, what is refused."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch
from splat_scenes import cloud, view
from torch import Tensor

from cap4d import _core
from cap4d.camera import Camera
from cap4d.errors import ArgumentError
from cap4d.raster import Rasterized, rasterize
from cap4d.raster.reference import rasterize_reference


def tensors(**options: float) -> list[Tensor]:
    g = cloud(40, **options)
    return [torch.from_numpy(x) for x in (g.means, g.quats, g.scales, g.opacities, g.sh)]


def leaves(**options: float) -> list[Tensor]:
    return [x.clone().requires_grad_() for x in tensors(**options)]


def test_means2d_collects_the_gradient_of_positions() -> None:
    """It predicts, per pixel, what a shift of the principal point does (through a smooth cut-off)."""
    camera = view(40, 30)
    inputs = leaves(spread=0.03, size=0.01)

    def loss(camera: Camera) -> tuple[Tensor, Rasterized]:
        out = rasterize_reference(*inputs, camera=camera, background=None, sh_degree=3, smooth_cutoff=0.3)
        return (out.rgb * torch.linspace(-1, 1, 40).double()[:, None]).sum(), out

    total, out = loss(camera)
    total.backward()
    left, right = (loss(camera.cropped(-shift, 0, 40, 30))[0].item() for shift in (-0.01, 0.01))
    assert out.means2d.grad[:, 0].sum().item() == pytest.approx((right - left) / 0.02, rel=1e-3)


def test_what_is_not_drawn_has_no_gradient() -> None:
    inputs = leaves()
    with torch.no_grad():
        inputs[0][3] += torch.tensor([0, 50.0, 0])
        inputs[3][5] = 0.001
    out = rasterize(*inputs, camera=view())
    out.rgb.sum().backward()
    for hidden in (3, 5):
        assert out.radii[hidden] == 0
        assert not out.means2d[hidden].any() and not out.means2d.grad[hidden].any()
        assert not any(x.grad[hidden].any() for x in inputs)
    assert (out.radii > 0).sum() == 38


def test_two_pictures_of_one_scene_add_their_gradients() -> None:
    once, twice = leaves(), leaves()
    rasterize(*once, camera=view()).rgb.sum().backward()
    rasterize(*once, camera=view(yaw_deg=-40)).rgb.sum().backward()
    sum(rasterize(*twice, camera=c).rgb.sum() for c in (view(), view(yaw_deg=-40))).backward()
    for a, b in zip(once, twice, strict=True):
        torch.testing.assert_close(a.grad, b.grad)


def test_large_gradients_stand_apart_while_they_are_held() -> None:
    """Their memory is used again, but only then."""
    g, camera = cloud(12_000), view()
    fields = g.means, g.quats, g.scales, g.opacities, g.sh
    seen = camera.viewmat, camera.K, camera.width, camera.height

    def v_sh(factor: float) -> np.ndarray:
        rgb, alpha, depth, _, _, rendered = _core.rasterize(*fields, *seen, None, -1, 2)
        v_rgb = np.full_like(rgb, factor)
        return _core.rasterize_vjp(rendered, *fields, -1, rgb, alpha, depth, v_rgb, None, None, 2)[4]

    first = v_sh(1)
    assert first.nbytes > 2 << 20 and first.ctypes.data % 64 == 0
    once = first.copy()
    assert once.any()
    second = v_sh(2)
    np.testing.assert_array_equal(first, once)
    np.testing.assert_allclose(second, 2 * once, rtol=1e-4, atol=1e-6)
    del first
    np.testing.assert_array_equal(v_sh(1), once)
    np.testing.assert_allclose(second, 2 * once, rtol=1e-4, atol=1e-6)


def test_double_inputs_get_double_gradients() -> None:
    inputs = [x.double().requires_grad_() for x in tensors()]
    rasterize(*inputs, camera=view()).rgb.sum().backward()
    assert all(x.grad.dtype == torch.float64 for x in inputs)


def test_without_gradients_nothing_is_kept() -> None:
    with torch.no_grad():
        out = rasterize(*leaves(), camera=view())
    assert not out.rgb.requires_grad and not out.means2d.requires_grad


def test_strided_inputs_are_read_right() -> None:
    inputs = tensors()
    strided = [
        torch.cat([x, x], -1)[..., : x.shape[-1]] if x.ndim > 1 else x.repeat_interleave(2)[::2]
        for x in inputs
    ]
    assert not strided[0].is_contiguous()
    assert torch.equal(rasterize(*strided, camera=view()).rgb, rasterize(*inputs, camera=view()).rgb)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_an_empty_scene_is_background(backend: str) -> None:
    inputs = [x[:0].requires_grad_() for x in tensors()]
    out = rasterize(*inputs, camera=view(), background=(0.1, 0.2, 0.3), backend=backend)
    assert torch.allclose(out.rgb.double(), torch.tensor([0.1, 0.2, 0.3]).double(), atol=1e-7)
    assert out.means2d.shape == (0, 2) and out.radii.shape == (0,)


def test_what_does_not_fit_is_refused() -> None:
    means, quats, scales, opacities, sh = tensors()
    with pytest.raises(ArgumentError, match=r"quats: expected float\[40, 4\]"):
        rasterize(means, quats[:, :3], scales, opacities, sh, camera=view())
    with pytest.raises(ArgumentError, match=r"sh: expected float\[40, 1\|4\|9\|16, 3\]"):
        rasterize(means, quats, scales, opacities, sh[:, :5], camera=view())
    with pytest.raises(ArgumentError, match="opacities"):
        rasterize(means, quats, scales, opacities.long(), sh, camera=view())
    with pytest.raises(ArgumentError, match="sh_degree: expected 0 to 3, got 4"):
        rasterize(means, quats, scales, opacities, sh, camera=view(), sh_degree=4)
    with pytest.raises(ArgumentError, match="backend"):
        rasterize(means, quats, scales, opacities, sh, camera=view(), backend="opengl")  # type: ignore[arg-type]


def test_the_tiles_of_the_reference_leave_nothing_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one tile, and with every Gaussian in every tile, the pictures are the same to rounding."""
    inputs, camera = tensors(spread=0.1, size=0.02), view(70, 50)
    options = {"camera": camera, "background": None, "sh_degree": 3}
    tiled = rasterize_reference(*inputs, **options)
    monkeypatch.setattr("cap4d.raster.reference.TILE", 128)
    whole = rasterize_reference(*inputs, **options)
    assert tiled.alpha.max() > 0.5
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(getattr(tiled, name), getattr(whole, name), rtol=1e-12, atol=1e-14)


def test_gsplat_is_asked_for_by_name() -> None:
    wanted = "CUDA" if importlib.util.find_spec("gsplat") else "not installed"
    with pytest.raises(ArgumentError, match=wanted):
        rasterize(*tensors(), camera=view(), backend="gsplat")


@pytest.mark.skipif(
    not (torch.cuda.is_available() and importlib.util.find_spec("gsplat")), reason="needs CUDA and gsplat"
)
def test_gsplat_agrees() -> None:
    """gsplat ends a Gaussian at three standard deviations, so the pictures are close, not equal."""
    inputs, camera = leaves(), view()
    cpu = rasterize(*inputs, camera=camera, background=(1, 1, 1))
    cuda = rasterize(*(x.cuda() for x in inputs), camera=camera, background=(1, 1, 1))
    assert (cpu.rgb - cuda.rgb.cpu()).abs().mean() < 2e-3
    cuda.rgb.sum().backward()
    assert cuda.means2d.grad.abs().sum() > 0
