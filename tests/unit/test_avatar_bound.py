"""The C++ binding operator against the generic one and its autograd, in double."""

import pytest
import torch

from cap4d.avatar.bound import bind_to
from cap4d.bind import bind, triangle_frames

VERTICES, FACES, GAUSSIANS = 40, 60, 300


@pytest.fixture
def scene():
    return make_scene(VERTICES, FACES, GAUSSIANS)


def make_scene(vertices, faces, gaussians):
    g = torch.Generator().manual_seed(0)
    corners = torch.stack([torch.randperm(vertices, generator=g)[:3] for _ in range(faces)])
    inputs = [
        torch.rand(vertices, 3, generator=g) * 0.1,
        torch.randn(gaussians, 3, generator=g),
        torch.randn(gaussians, 4, generator=g),
        torch.randn(gaussians, 3, generator=g) * 0.3,
    ]
    binding = torch.randint(faces, (gaussians,), generator=g)
    weights = [torch.randn(gaussians, k, generator=g) for k in (3, 4, 3)]
    return corners, inputs, binding, weights


def outputs_and_gradients(function, inputs, weights, dtype):
    leaves = [x.to(dtype).requires_grad_() for x in inputs]
    outputs = function(*leaves)
    sum((o * w.to(dtype)).sum() for o, w in zip(outputs, weights, strict=True)).backward()
    return [o.detach() for o in outputs], [x.grad for x in leaves]


def test_values_and_gradients_are_those_of_the_generic_form(scene):
    faces, inputs, binding, weights = scene

    def generic(vertices, means, quats, log_scales):
        frames = triangle_frames(vertices, faces)
        return bind(frames, means=means, quats=quats, log_scales=log_scales, binding=binding)

    def fast(vertices, means, quats, log_scales):
        local = dict(means=means, quats=quats, log_scales=log_scales, binding=binding.int())
        return bind_to(vertices, faces.int(), **local)

    expected = outputs_and_gradients(generic, inputs, weights, torch.float64)
    found = outputs_and_gradients(fast, inputs, weights, torch.float32)
    for many, more in zip(expected, found, strict=True):
        for a, b in zip(many, more, strict=True):
            assert float((a - b).abs().max() / a.abs().max()) < 2e-6


def test_gradients_do_not_depend_on_the_number_of_threads():
    """Of more vertices, faces and Gaussians than one piece of work (2048) holds."""
    from cap4d import _core

    faces, (vertices, means, quats, log_scales), binding, weights = make_scene(5000, 5000, 7000)
    arrays = [x.numpy() for x in (vertices, faces.int(), means, quats, log_scales, binding.int(), *weights)]
    one, three = (_core.bind_vjp(*arrays, threads) for threads in (1, 3))
    assert all((a == b).all() for a, b in zip(one, three, strict=True))


def test_a_triangle_without_area_passes_finite_gradients(scene):
    faces, inputs, binding, weights = scene
    inputs[0][faces[0]] = inputs[0][faces[0][0]].clone()  # a point
    a, b, c = faces[1]
    inputs[0][c] = 2 * inputs[0][b] - inputs[0][a]  # a line

    def fast(vertices, means, quats, log_scales):
        local = dict(means=means, quats=quats, log_scales=log_scales, binding=binding.int())
        return bind_to(vertices, faces.int(), **local)

    outputs, gradients = outputs_and_gradients(fast, inputs, weights, torch.float32)
    assert all(torch.isfinite(x).all() for x in (*outputs, *gradients))
