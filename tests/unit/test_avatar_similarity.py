"""The compiled SSIM and L1 against the plain ones and their autograd, in double."""

import pytest
import torch

from cap4d import _core
from cap4d.avatar.losses import ssim_map
from cap4d.avatar.similarity import l1_and_ssim


def images(height, width, channels=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, channels, generator=g)
    y = (x + 0.2 * torch.randn(x.shape, generator=g)).clamp(0, 1)
    y[0, 0] = x[0, 0]  # equal values, where the absolute difference has no slope
    return x, y


@pytest.mark.parametrize("shape", [(40, 37, 3), (7, 5, 3), (1, 1, 1), (12, 64, 4)])
def test_values_and_gradient_are_those_of_the_plain_form(shape):
    x, y = images(*shape)
    leaf, exact = x.clone().requires_grad_(), x.double().requires_grad_()
    absolute, similar = l1_and_ssim(leaf, y)
    (0.6 * absolute + 0.4 * (1 - similar)).backward()
    expected = ((exact - y.double()).abs().mean(), ssim_map(exact, y.double()).mean())
    (0.6 * expected[0] + 0.4 * (1 - expected[1])).backward()
    assert abs(absolute.item() - expected[0].item()) < 1e-6
    assert abs(similar.item() - expected[1].item()) < 1e-5
    largest = exact.grad.abs().max()
    assert float((leaf.grad - exact.grad).abs().max()) <= 2e-6 * float(largest) + 2e-7


def test_the_bits_do_not_depend_on_the_number_of_threads():
    x, y = (image.numpy() for image in images(70, 41))
    found = []
    for threads in (1, 3):
        absolute, similar, partials = _core.similarity(x, y, threads)
        v_image = _core.similarity_vjp(x, y, partials, 0.6, -0.4, threads)
        found.append((absolute, similar, partials.tobytes(), v_image.tobytes()))
    assert found[0] == found[1]


def test_shapes_that_do_not_fit_are_refused():
    x, y = (image.numpy() for image in images(9, 9))
    with pytest.raises(ValueError, match="target"):
        _core.similarity(x, y[:5].copy())
    with pytest.raises(ValueError, match="image"):
        _core.similarity(x[0], y[0])
    partials = _core.similarity(x, y)[2]
    with pytest.raises(ValueError, match="partials"):
        _core.similarity_vjp(x, y, partials[:2].copy(), 1.0, 1.0)
