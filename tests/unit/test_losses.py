"""Every term against its formula, written out slowly in float64."""

import numpy as np
import torch

from cap4d.avatar import losses
from cap4d.avatar.losses import LossWeights
from cap4d.evaluate.image import ssim
from cap4d.rotation import axis_angle_to_rotmat


def images(seed=0, height=20, width=24):
    rng = np.random.default_rng(seed)
    smooth = rng.random((height, width, 3))
    return torch.from_numpy(smooth), torch.from_numpy(
        np.clip(smooth + 0.2 * rng.standard_normal(smooth.shape), 0, 1)
    )


def slow_ssim_map(x, y):
    """One pixel and channel after the other, with the window cut at the border as zero padding does."""
    k = np.arange(11) - 5
    window = np.exp(-(k[:, None] ** 2 + k**2) / (2 * 1.5**2))
    window /= window.sum()
    height, width, channels = x.shape
    out = np.zeros(x.shape)
    for r in range(height):
        for c in range(width):
            for ch in range(channels):
                sums = np.zeros(5)
                for i in range(-5, 6):
                    for j in range(-5, 6):
                        if 0 <= r + i < height and 0 <= c + j < width:
                            a, b = x[r + i, c + j, ch], y[r + i, c + j, ch]
                            sums += window[i + 5, j + 5] * np.array([a, b, a * a, b * b, a * b])
                ma, mb, aa, bb, ab = sums
                va, vb, cov = aa - ma * ma, bb - mb * mb, ab - ma * mb
                top = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4)
                out[r, c, ch] = top / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))
    return out


def test_ssim_map_and_photometric():
    x, y = images(height=9, width=13)
    expected = slow_ssim_map(x.numpy(), y.numpy())
    np.testing.assert_allclose(losses.ssim_map(x, y).numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(losses.ssim_map(x.float(), y.float()).numpy(), expected, atol=2e-4)
    weights = LossWeights()
    by_hand = 0.6 * np.abs(x.numpy() - y.numpy()).mean() + 0.4 * (1 - expected.mean())
    assert abs(float(losses.photometric(x, y, weights)) - by_hand) < 1e-12
    squared = float(losses.photometric(x, y, LossWeights(l2=5.0))) - by_hand
    assert abs(squared - 5 * np.square(x.numpy() - y.numpy()).mean()) < 1e-12


def test_ssim_away_from_the_border_is_that_of_the_evaluation():
    x, y = images()
    inner = losses.ssim_map(x, y)[5:-5, 5:-5].mean()
    assert abs(float(inner) - ssim(x.numpy(), y.numpy())) < 1e-12


def test_photometric_gradient():
    x, y = images(height=12, width=12)
    x.requires_grad_()
    assert torch.autograd.gradcheck(lambda image: losses.photometric(image, y, LossWeights()), x, atol=1e-6)


def test_position_and_scale_count_only_what_is_visible():
    means = torch.tensor([[0.0, 2.5, -3.0], [9.0, 9.0, 9.0], [0.1, 0.2, 0.3]])
    visible = torch.tensor([True, False, True])
    assert abs(float(losses.axis_position_loss(means, visible, 2.0)) - (0.5 + 1.0) / 3 / 2) < 1e-7
    assert abs(float(losses.position_loss(means, visible, 2.0)) - (15.25**0.5 - 2) / 2) < 1e-6
    scales = torch.tensor([[4.0, 5.0, 0.5], [9.0, 9.0, 9.0], [0.5, 0.5, 0.5]])
    assert abs(float(losses.scale_loss(scales.log(), visible, 1.0)) - 5.0 / 2) < 1e-5
    assert float(losses.position_loss(means, torch.zeros(3, dtype=torch.bool), 2.0)) == 0


def test_scale_loss_has_a_gradient_everywhere():
    log_scales = torch.zeros(4, 3, requires_grad=True)
    losses.scale_loss(log_scales, torch.ones(4, dtype=torch.bool), 1.0).backward()
    assert torch.isfinite(log_scales.grad).all()


def test_laplacian():
    maps = torch.randn(2, 3, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.01
    m = maps.numpy() / 0.0108
    total = 0.0
    for b in range(2):
        for r in range(1, 5):
            for c in range(1, 6):
                around = m[b, :, r - 1, c] + m[b, :, r + 1, c] + m[b, :, r, c - 1] + m[b, :, r, c + 1]
                total += np.square(around - 4 * m[b, :, r, c]).sum()
    assert abs(float(losses.laplacian_loss(maps)) - total / (2 * 4 * 5)) < 1e-9 * total


def test_relative_deformation():
    moved, neutral = torch.tensor([[0.0108, 0.0, 0.0], [0.0, 0.0, 0.0]]), torch.zeros(2, 3)
    assert abs(float(losses.relative_deformation_loss(moved, neutral)) - 0.5) < 1e-6


def test_relative_rotation_is_the_mean_squared_angle():
    rng = np.random.default_rng(0)
    vectors = torch.from_numpy(rng.standard_normal((50, 3)) * rng.choice([1e-3, 0.3, 1.5], (50, 1)))
    vectors *= (3.0 / vectors.norm(dim=1, keepdim=True)).clamp(max=1)  # angles below pi
    neutral = axis_angle_to_rotmat(torch.from_numpy(rng.standard_normal((50, 3))))
    loss = losses.relative_rotation_loss(neutral @ axis_angle_to_rotmat(vectors), neutral)
    assert abs(float(loss) - float(vectors.square().sum(1).mean())) < 1e-7


def test_relative_rotation_has_a_gradient_at_rest():
    vectors = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    identity = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    losses.relative_rotation_loss(axis_angle_to_rotmat(vectors), identity).backward()
    assert torch.isfinite(vectors.grad).all()


def test_gradient_distance():
    x, y = images(height=16, width=20)
    d = (x - y).numpy()
    expected = 0.0
    for _ in range(3):
        expected += np.abs(np.diff(d, axis=0)).mean() + np.abs(np.diff(d, axis=1)).mean()
        h, w = d.shape[0] // 2, d.shape[1] // 2
        d = d[: 2 * h, : 2 * w].reshape(h, 2, w, 2, 3).mean((1, 3))
    assert abs(float(losses.gradient_distance(x, y)) - expected) < 1e-12
    assert float(losses.gradient_distance(x, x)) == 0
    assert float(losses.gradient_distance(x, x + 0.1)) < 1e-12  # a change of tone has no edges
    leaf = x.clone().requires_grad_()
    losses.gradient_distance(leaf, y).backward()
    direction = torch.from_numpy(np.random.default_rng(5).normal(size=x.shape))
    h = 1e-9  # too small for a difference to change its sign
    ends = [losses.gradient_distance(x + s * h * direction, y) for s in (1, -1)]
    slope = float(ends[0] - ends[1]) / (2 * h)
    assert abs(float((leaf.grad * direction).sum()) - slope) < 1e-5 * abs(slope)
