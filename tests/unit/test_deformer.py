"""The deformation U-Net: the released names and shapes, its start at zero, what it reads."""

import numpy as np
import pytest
import torch

from cap4d.avatar.deformer import DEFORM_STD, Deformer, downsamplings, positional_encoding

# The released state dict, outermost to innermost: down 27->64->128->256->512->512->512, then up (fact 22).
RELEASED = {
    "model.model.0": (64, 27),
    "model.model.1.model.1": (128, 64),
    "model.model.1.model.3.model.1": (256, 128),
    "model.model.1.model.3.model.3.model.1": (512, 256),
    "model.model.1.model.3.model.3.model.3.model.1": (512, 512),
    "model.model.1.model.3.model.3.model.3.model.3.model.1": (512, 512),
    "model.model.1.model.3.model.3.model.3.model.3.model.3": (512, 512),
    "model.model.1.model.3.model.3.model.3.model.5": (1024, 512),
    "model.model.1.model.3.model.3.model.5": (1024, 256),
    "model.model.1.model.3.model.5": (512, 128),
    "model.model.1.model.5": (256, 64),
    "model.model.3": (128, 3),
}


def small(size=16, width=4, seed=0):
    return Deformer(np.ones((size, size), bool), width=width, generator=torch.Generator().manual_seed(seed))


def test_names_and_shapes_are_the_released_ones():
    state = Deformer(np.ones((128, 128), bool)).state_dict()
    expected = {}
    for name, (first, second) in RELEASED.items():
        up = (first > second and name.endswith("model.5")) or name in list(RELEASED)[6:]
        expected[f"{name}.weight"] = (first, second, 4, 4)
        expected[f"{name}.bias"] = (second if up else first,)
    assert {name: tuple(value.shape) for name, value in state.items()} == expected
    assert sum(value.numel() for value in state.values()) == 29_266_307


def test_it_starts_at_zero_deformation_and_learns_from_there():
    net = small()
    offsets = torch.randn(2, 3, 16, 16) * DEFORM_STD
    out = net(offsets)
    assert out.shape == (2, 3, 16, 16)
    assert not out.any()
    out.sum().backward()
    assert net.model.model[-1].weight.grad.abs().max() > 0


def test_initial_weights_have_the_released_spread():
    net = Deformer(np.ones((64, 64), bool), width=32, generator=torch.Generator().manual_seed(1))
    weights = [p for name, p in net.named_parameters() if name.endswith("weight")][:-1]
    assert all(abs(float(w.detach().std()) - 0.02) < 1e-3 for w in weights)
    assert not any(p.any() for name, p in net.named_parameters() if name.endswith("bias"))


def test_offsets_outside_the_mask_are_not_read():
    valid = np.zeros((16, 16), bool)
    valid[4:12, 4:12] = True
    net = Deformer(valid, width=4, generator=torch.Generator().manual_seed(0))
    torch.nn.init.normal_(net.model.model[-1].weight, generator=torch.Generator().manual_seed(1))
    offsets = torch.randn(1, 3, 16, 16, generator=torch.Generator().manual_seed(2)) * DEFORM_STD
    spoiled = offsets.clone()
    spoiled[..., ~torch.from_numpy(valid)] = 7.0
    assert torch.equal(net(offsets), net(spoiled))
    spoiled[..., 5, 5] += 0.01
    assert not torch.equal(net(offsets), net(spoiled))


def test_positional_encoding_by_hand():
    encoding = positional_encoding(128)
    assert encoding.shape == (24, 128, 128)
    row, column, k = 5, 77, 3
    y, x = row / 128 * 2 - 1, column / 128 * 2 - 1
    by_hand = [np.sin(y * 2**k), np.cos(y * 2**k), np.sin(x * 2**k), np.cos(x * 2**k)]
    np.testing.assert_allclose(encoding[[k, 6 + k, 12 + k, 18 + k], row, column], by_hand, atol=1e-6)


def test_depth_follows_the_grid():
    assert [downsamplings(s) for s in (8, 16, 128, 256)] == [2, 3, 6, 6]
    with pytest.raises(ValueError, match="power of two"):
        downsamplings(100)


def test_the_same_generator_gives_the_same_network():
    a, b, c = small(seed=3), small(seed=3), small(seed=4)
    first = [next(iter(net.parameters())) for net in (a, b, c)]
    assert torch.equal(first[0], first[1])
    assert not torch.equal(first[0], first[2])
