"""The compiled deformation network and its gradient against torch's autograd in double."""

import copy
import pickle

import numpy as np
import pytest
import torch

from cap4d import _core
from cap4d.avatar.deformer import DEFORM_STD, Deformer


def network(size, width, seed=0):
    """One whose weights and biases are far from where they start, so that every part of it matters."""
    g = torch.Generator().manual_seed(seed)
    valid = torch.rand(size, size, generator=g).numpy() < 0.9
    net = Deformer(valid, width=width, generator=g)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(0.2 * torch.randn(parameter.shape, generator=g))
    return net


def answers_and_gradients(net, offsets, weights):
    net.zero_grad(set_to_none=True)
    out = net(offsets)
    (out * weights).sum().backward()
    return out.detach(), {name: p.grad.clone() for name, p in net.named_parameters()}


@pytest.mark.parametrize(
    ("size", "width", "batch"), [(8, 3, 2), (16, 4, 1), (32, 16, 2), (64, 5, 2), (128, 16, 2)]
)
def test_values_and_gradients_are_those_of_torch(size, width, batch):
    net = network(size, width)
    exact = copy.deepcopy(net).double()
    g = torch.Generator().manual_seed(1)
    offsets = DEFORM_STD * torch.randn(batch, 3, size, size, generator=g)
    weights = torch.randn(batch, 3, size, size, generator=g)
    expected = answers_and_gradients(exact, offsets.double(), weights.double())
    for _ in range(2):  # the second in memory that the first one left
        out, gradients = answers_and_gradients(net, offsets, weights)
        assert float((out - expected[0]).abs().max()) < 1e-4 * float(expected[0].abs().max())
        for name, gradient in gradients.items():
            largest = max(
                float(v.abs().max()) for n, v in expected[1].items() if n == name.replace("bias", "weight")
            )
            assert float((gradient - expected[1][name]).abs().max()) < 3e-4 * largest, name
    assert len(net._fast._idle) == 1


def test_the_bits_do_not_depend_on_the_number_of_threads():
    net = network(64, 8)
    offsets = torch.randn(2, 3, 64, 64, generator=torch.Generator().manual_seed(2)).numpy()
    down, up = ([x.detach().numpy() for x in way] for way in net.model.tensors())
    down, up = (list(zip(way[::2], way[1::2], strict=True)) for way in (down, up))
    found = []
    for threads in (1, 3):
        run = _core.UnetPass(8, 2, net.encoding.numpy())
        out = run.forward(offsets, down, up, threads)
        gradients = run.backward(out, threads)
        found.append(
            b"".join(x.tobytes() for x in (out, *(a for way in gradients for pair in way for a in pair)))
        )
    assert found[0] == found[1]


def test_offsets_that_want_a_gradient_go_through_torch():
    net = network(16, 4)
    offsets = torch.randn(1, 3, 16, 16).requires_grad_()
    net(offsets).sum().backward()
    assert offsets.grad.abs().max() > 0
    assert net._fast is None


def test_a_pass_that_no_gradient_follows_gives_its_memory_back_and_one_that_does_can_be_used_once():
    net = network(16, 4)
    offsets = torch.randn(2, 3, 16, 16)
    with torch.no_grad():
        net(offsets)
    assert len(net._fast._idle) == 1
    first, second = net(offsets), net(offsets)  # two on their way at once
    loss = first.sum() + second.sum()
    loss.backward(retain_graph=True)
    assert len(net._fast._idle) == 2
    with pytest.raises(RuntimeError, match="can be taken once"):
        loss.backward()


def test_copies_and_pickles_leave_the_memory_behind():
    net = network(16, 4)
    offsets = torch.randn(1, 3, 16, 16)
    with torch.no_grad():
        expected = net(offsets)
        for twin in (copy.deepcopy(net), pickle.loads(pickle.dumps(net))):
            assert torch.equal(twin(offsets), expected)


def test_tensors_that_do_not_fit_are_refused():
    net = network(16, 4)
    down, up = ([x.detach().numpy() for x in way] for way in net.model.tensors())
    down, up = (list(zip(way[::2], way[1::2], strict=True)) for way in (down, up))
    run = _core.UnetPass(4, 1, net.encoding.numpy())
    offsets = np.zeros((1, 3, 16, 16), np.float32)
    with pytest.raises(ValueError, match="offsets"):
        run.forward(offsets[:, :2].copy(), down, up)
    with pytest.raises(ValueError, match=r"down 0\.weight"):
        run.forward(offsets, [down[1], *down[1:]], up)
    with pytest.raises(ValueError, match="up layers: expected 3"):
        run.forward(offsets, down, up[:-1])
    with pytest.raises(ValueError, match="v_out"):
        run.backward(offsets[..., :8].copy())
    with pytest.raises(ValueError, match="encoding"):
        _core.UnetPass(4, 1, np.zeros((2, 16, 8), np.float32))
    with pytest.raises(ValueError):
        _core.UnetPass(4, 1, np.zeros((2, 12, 12), np.float32))
