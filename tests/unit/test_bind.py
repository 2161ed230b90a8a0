"""Gaussians on triangles: the frames of a known triangle, degenerate ones, and NumPy = torch = C++."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from parity import tolerances as tol

from cap4d.bind import bind, bind_fast, triangle_frames
from cap4d.rotation import axis_angle_to_rotmat, quat_to_rotmat


def mesh(seed: int = 0, vertices: int = 60, faces: int = 90) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    corners = np.stack([rng.permutation(vertices)[:3] for _ in range(faces)])
    return rng.normal(0, 0.1, (vertices, 3)).astype(np.float32), corners.astype(np.int32)


def local(seed: int = 0, count: int = 300, faces: int = 90) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    fields = {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)) * np.exp(rng.normal(0, 2, (count, 1))),
        "log_scales": rng.normal(-1, 1, (count, 3)),
    }
    return {k: v.astype(np.float32) for k, v in fields.items()} | {
        "binding": rng.integers(0, faces, count).astype(np.int32)
    }


def test_frame_of_a_known_triangle() -> None:
    """First edge 2 along x, height 3 along y: normal z, third axis -(z x x) = -y (fact 27)."""
    vertices = np.array([[1.0, 1, 1], [3, 1, 1], [1, 4, 1]])
    centres, rotmats, sizes = triangle_frames(vertices, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(centres, [[5 / 3, 2, 1]])
    np.testing.assert_allclose(rotmats[0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    assert sizes[0] == pytest.approx((2 + 3) / 2)


def test_frames_are_rotations() -> None:
    _, rotmats, _ = triangle_frames(*mesh())
    np.testing.assert_allclose(rotmats @ rotmats.mT, np.broadcast_to(np.eye(3), rotmats.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotmats), 1, atol=1e-5)


def test_a_gaussian_at_rest_is_the_triangle() -> None:
    vertices, faces = mesh()
    rest = {
        "means": np.zeros((90, 3), np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (90, 1)),
        "log_scales": np.zeros((90, 3), np.float32),
        "binding": np.arange(90, dtype=np.int32),
    }
    centres, rotmats, sizes = triangle_frames(vertices, faces)
    means, quats, scales = bind_fast(vertices, faces, **rest)
    np.testing.assert_allclose(means, centres, atol=1e-6)
    np.testing.assert_allclose(scales, np.repeat(sizes[:, None], 3, 1), rtol=1e-5)
    np.testing.assert_allclose(quat_to_rotmat(quats), rotmats, atol=1e-5)


def test_fast_is_the_reference() -> None:
    vertices, faces = mesh()
    parameters = local()
    double = {k: v.astype(np.float64) if v.dtype == np.float32 else v for k, v in parameters.items()}
    expected = bind(triangle_frames(vertices.astype(np.float64), faces), **double)
    for got, want in zip(bind_fast(vertices, faces, **parameters), expected, strict=True):
        sign = np.sign((got * want).sum(-1, keepdims=True)) if got.shape[1] == 4 else 1
        assert np.abs(got * sign - want).max() <= tol.BIND * 5 * np.abs(want).max()


def test_torch_is_numpy_and_has_gradients() -> None:
    vertices, faces = mesh()
    parameters = local()
    tensors = {k: torch.from_numpy(v) for k, v in parameters.items()}
    frames = triangle_frames(torch.from_numpy(vertices), torch.from_numpy(faces))
    expected = bind(triangle_frames(vertices, faces), **parameters)
    for got, want in zip(bind(frames, **tensors), expected, strict=True):
        np.testing.assert_allclose(got.numpy(), want, rtol=1e-5, atol=1e-5)

    def posed(vertices: torch.Tensor, means: torch.Tensor, quats: torch.Tensor, log_scales: torch.Tensor):
        frames = triangle_frames(vertices, torch.from_numpy(faces[:4]))
        return bind(frames, means=means, quats=quats, log_scales=log_scales, binding=torch.arange(4))

    small = [torch.from_numpy(vertices)] + [tensors[k][:4] for k in ("means", "quats", "log_scales")]
    assert torch.autograd.gradcheck(posed, [x.double().requires_grad_() for x in small])


def test_batches_of_meshes() -> None:
    vertices, faces = mesh()
    parameters = local()
    both = bind(triangle_frames(np.stack([vertices, 2 * vertices]), faces), **parameters)
    for i, factor in enumerate((1, 2)):
        single = bind(triangle_frames(factor * vertices, faces), **parameters)
        for a, b in zip(both, single, strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-7)


def test_a_rigid_motion_carries_the_gaussians_along() -> None:
    vertices, faces = mesh()
    rotation = axis_angle_to_rotmat(np.array([0.4, -1.1, 0.7]))
    moved = (vertices @ rotation.T + [0.1, 0.2, 0.3]).astype(np.float32)
    before, after = (bind_fast(v, faces, **local()) for v in (vertices, moved))
    np.testing.assert_allclose(after[0], before[0] @ rotation.T + [0.1, 0.2, 0.3], atol=1e-5)
    np.testing.assert_allclose(quat_to_rotmat(after[1]), rotation @ quat_to_rotmat(before[1]), atol=1e-4)
    np.testing.assert_allclose(after[2], before[2], rtol=1e-4)


DEGENERATE = {
    "point": [[1, 1, 1], [1, 1, 1], [1, 1, 1]],
    "no_first_edge": [[1, 1, 1], [1, 1, 1], [2, 1, 1]],
    "no_second_edge": [[1, 1, 1], [2, 1, 1], [1, 1, 1]],
    "line": [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
    "tiny": [[0, 0, 0], [1e-15, 0, 0], [0, 1e-15, 0]],
}


@pytest.mark.parametrize("triangle", DEGENERATE.values(), ids=DEGENERATE)
def test_triangles_without_area_stay_finite(triangle: list) -> None:
    vertices, faces = np.array(triangle, np.float32), np.array([[0, 1, 2]], np.int32)
    parameters = local(count=5, faces=1)
    fast = bind_fast(vertices, faces, **parameters)
    assert all(np.isfinite(x).all() for x in fast)
    np.testing.assert_allclose(np.linalg.norm(fast[1], axis=1), 1, atol=1e-5)
    leaf = torch.from_numpy(vertices).requires_grad_()
    tensors = {k: torch.from_numpy(v) for k, v in parameters.items()}
    slow = bind(triangle_frames(leaf, torch.from_numpy(faces)), **tensors)
    for got, want in zip(fast, slow, strict=True):
        np.testing.assert_allclose(got, want.detach().numpy(), rtol=1e-4, atol=1e-5)
    slow[0].sum().backward()
    assert torch.isfinite(leaf.grad).all()


def test_a_zero_quaternion_stays_finite() -> None:
    parameters = local()
    parameters["quats"][3] = 0
    assert np.isfinite(bind_fast(*mesh(), **parameters)[1]).all()


def test_what_does_not_fit_is_refused() -> None:
    vertices, faces = mesh()
    parameters = local()
    with pytest.raises(ValueError, match="binding: index 90 is out of range"):
        bind_fast(vertices, faces, **(parameters | {"binding": np.full(300, 90, np.int32)}))
    with pytest.raises(ValueError, match="faces: index -1 is out of range"):
        bind_fast(vertices, -np.ones_like(faces), **parameters)
    with pytest.raises(ValueError, match=r"quats: expected \[300, 4\]"):
        bind_fast(vertices, faces, **(parameters | {"quats": parameters["means"]}))
    with pytest.raises(TypeError):
        bind_fast(vertices.astype(np.float64), faces, **parameters)


def test_threads_do_not_change_it() -> None:
    """Of more faces and Gaussians than one piece of work (2048) holds."""
    scene, gaussians = mesh(vertices=3000, faces=5000), local(count=7000, faces=5000)
    one, many = (bind_fast(*scene, **gaussians, threads=t) for t in (1, 4))
    assert all(np.array_equal(a, b) for a, b in zip(one, many, strict=True))
