"""Binding to triangles that hardly are any, and its gradient, against float64; rotations near 0 and pi."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hard_meshes import FLAT, MESHES, Mesh, flat_among_others, slivers
from hypothesis import given, settings
from hypothesis import strategies as st
from parity import tolerances as tol

from cap4d import _core
from cap4d.bind import bind, triangle_frames
from cap4d.rotation import axis_angle_to_rotmat, quat_to_rotmat, rotmat_to_axis_angle, rotmat_to_quat

NAMES = ("vertices", "means", "quats", "log_scales")


def local(count: int, faces: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Gaussians on random triangles, with quaternions of norms from 1e-6 to 1e30."""
    rng = np.random.default_rng(seed)
    norms = 10.0 ** rng.uniform(-6, 30, (count, 1))
    return {
        "means": rng.normal(size=(count, 3)).astype(np.float32),
        "quats": (rng.normal(size=(count, 4)) * norms).astype(np.float32),
        "log_scales": rng.normal(-1, 1, (count, 3)).astype(np.float32),
        "binding": rng.integers(0, faces, count).astype(np.int32),
    }


def fast(
    mesh: Mesh, gaussians: dict[str, np.ndarray], weights: list[np.ndarray], threads: int = 2
) -> list[np.ndarray]:
    """Posed means, quats and scales, then the gradients of NAMES."""
    arrays = (*mesh, *gaussians.values())
    return [*_core.bind(*arrays, threads), *_core.bind_vjp(*arrays, *weights, threads)]


def slow(mesh: Mesh, gaussians: dict[str, np.ndarray], weights: list[np.ndarray]) -> list[np.ndarray]:
    """`fast` by the readable form in float64."""
    vertices, means, quats, log_scales = (
        torch.from_numpy(x).double().requires_grad_() for x in (mesh[0], *list(gaussians.values())[:3])
    )
    faces, binding = torch.from_numpy(mesh[1]), torch.from_numpy(gaussians["binding"])
    posed = bind(
        triangle_frames(vertices, faces), means=means, quats=quats, log_scales=log_scales, binding=binding
    )
    loss = sum((x * torch.from_numpy(w)).sum() for x, w in zip(posed, weights, strict=True))
    grads = torch.autograd.grad(loss, (vertices, means, quats, log_scales))
    return [x.detach().numpy() for x in (*posed, *grads)]


def some_weights(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(9)
    return [rng.normal(size=(count, n)).astype(np.float32) for n in (3, 4, 3)]


def rows_off(a: np.ndarray, b: np.ndarray, floor: float = 0.0) -> float:
    """The largest error of a row, relative to its norm plus a share `floor` of the largest row's."""
    size = np.linalg.norm(b, axis=1)
    return float((np.linalg.norm(a - b, axis=1) / (size + floor * size.max() + 1e-30)).max())


@pytest.mark.parametrize("name", MESHES)
def test_binding_agrees(name: str) -> None:
    mesh = MESHES[name]()
    gaussians, weights = local(300, len(mesh[1])), some_weights(300)
    got, want = fast(mesh, gaussians, weights), slow(mesh, gaussians, weights)
    assert all(np.isfinite(x).all() for x in (*got, *want))
    off = [rows_off(a, b) for a, b in zip(got[:3], want[:3], strict=True)]
    off += [rows_off(a, b, tol.GRADIENT_FLOOR) for a, b in zip(got[3:], want[3:], strict=True)]
    print(f"{name}: posed {max(off[:3]):.1e}, gradients {max(off[3:]):.1e}")
    assert max(off[:3]) <= tol.HARD_BIND
    assert max(off[3:]) <= tol.HARD_BIND_GRADIENT
    assert all(np.array_equal(a, b) for a, b in zip(got, fast(mesh, gaussians, weights, 1), strict=True))


@pytest.mark.parametrize("name", FLAT)
def test_triangles_without_area(name: str) -> None:
    """Finite, as in float64, with gradients that move the centre alone; and no neighbour notices."""
    vertices, faces = flat_among_others(name)
    gaussians, weights = local(40, 4), some_weights(40)
    got, want = fast((vertices, faces), gaussians, weights), slow((vertices, faces), gaussians, weights)
    assert all(np.isfinite(x).all() for x in got)
    for a, b in zip(got[:3], want[:3], strict=True):
        assert rows_off(a, b) <= tol.HARD_BIND
    if name != "long":
        pull = got[3][:3]
        on_it = gaussians["binding"] == 0
        np.testing.assert_allclose(pull, np.tile(weights[0][on_it].sum(0) / 3, (3, 1)), rtol=1e-5, atol=1e-5)
    assert rows_off(got[3][3:], want[3][3:], tol.GRADIENT_FLOOR) <= tol.HARD_BIND_GRADIENT


POISON = np.float32([0, -0.0, 1e-45, -1e-40, 1e-38, 1e19, 1e30, -3.4e38, np.nan, np.inf, -np.inf])


@settings(max_examples=300, deadline=None)
@given(
    field=st.sampled_from(NAMES),
    at=st.integers(0, 10**6),
    value=st.sampled_from(POISON.tolist()),
    whole=st.booleans(),
)
def test_no_number_spreads(field: str, at: int, value: float, whole: bool) -> None:
    """A bad vertex takes its triangles' Gaussians, a bad Gaussian only itself; nobody else's bits change."""
    mesh = slivers(5e-3, count=6)
    gaussians = local(24, 6)
    arrays = {"vertices": mesh[0].copy()} | {k: v.copy() for k, v in gaussians.items()}
    row = at % len(arrays[field])
    part = slice(None) if whole else at // 1000 % arrays[field].shape[1]
    arrays[field][row, part] = value
    bad_mesh = (arrays.pop("vertices"), mesh[1])
    hit = gaussians["binding"] == row // 3 if field == "vertices" else np.arange(24) == row
    posed = _core.bind(*bad_mesh, *arrays.values())
    gone = ~(np.abs(np.concatenate(posed, 1)) < 1e7).all(1)  # not drawn: rendering sends nothing back
    assert not gone[~hit].any()
    weights = [np.where(gone[:, None], 0, w).astype(np.float32) for w in some_weights(24)]
    got = fast(bad_mesh, arrays, weights)
    assert all(np.isfinite(x).all() for x in got[3:])
    assert not any(x[gone].any() for x in got[4:])
    sound = fast(mesh, gaussians, weights)
    for a, b in zip((*got[:3], *got[4:]), (*sound[:3], *sound[4:]), strict=True):
        assert np.array_equal(a[~hit], b[~hit])
    if gone.any():
        kept = {k: v[~gone] for k, v in arrays.items()}
        without = fast(bad_mesh, kept, [w[~gone] for w in weights])
        assert np.array_equal(got[3], without[3])


def test_a_quaternion_of_no_length_has_a_finite_gradient() -> None:
    mesh, gaussians = slivers(5e-3, count=4), local(8, 4)
    gaussians["quats"][:4] = np.float32([0, 1e-45, 1e-38, 1e-11])[:, None]
    got, want = (run(mesh, gaussians, some_weights(8)) for run in (fast, slow))
    assert all(np.isfinite(x).all() for x in got)
    assert rows_off(got[1], want[1]) <= tol.HARD_BIND
    assert rows_off(got[5], want[5]) <= tol.HARD_BIND_GRADIENT


ANGLES = [
    0.0,
    1e-300,
    1e-20,
    1e-10,
    1e-8,
    0.99e-4,
    1.01e-4,
    1e-3,
    np.pi - 1e-4,
    np.pi - 1e-8,
    np.pi,
    np.pi + 1e-8,
]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_near_none_and_near_half_a_turn(angle: float, dtype: type) -> None:
    """Rotations stay rotations, and come back as the same, to the precision of the number."""
    rng = np.random.default_rng(4)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(50, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    eps = float(np.finfo(dtype).eps)
    rotmat = axis_angle_to_rotmat((axes * angle).astype(dtype))
    assert rotmat.dtype == dtype
    unit = np.broadcast_to(np.eye(3), rotmat.shape)
    errors = {
        "orthonormal": np.abs(rotmat @ rotmat.swapaxes(1, 2) - unit).max(),
        "quaternion": np.abs(quat_to_rotmat(rotmat_to_quat(rotmat)) - rotmat).max(),
        "vector": np.abs(axis_angle_to_rotmat(rotmat_to_axis_angle(rotmat)) - rotmat).max(),
    }
    print(angle, dtype.__name__, {k: f"{v / eps:.1f} eps" for k, v in errors.items()})
    assert max(errors.values()) <= tol.ROTATION * eps, errors


@pytest.mark.parametrize("scale", [0.0, 1e-160, 1e-20, 1e20, 1e150])
def test_quaternions_of_any_norm_are_rotations(scale: float) -> None:
    quats = np.random.default_rng(5).normal(size=(50, 4)) * scale
    rotmat = quat_to_rotmat(quats)
    assert np.abs(rotmat @ rotmat.swapaxes(1, 2) - np.eye(3)).max() <= 1e-6


def test_gradients_of_rotations_are_finite() -> None:
    axes = torch.eye(3, dtype=torch.float64)
    for angle in ANGLES:
        rotvec = (axes * angle).requires_grad_()
        rotmat = axis_angle_to_rotmat(rotvec)
        weights = torch.arange(9.0, dtype=torch.float64).reshape(3, 3)
        (grad,) = torch.autograd.grad((rotmat * weights).sum(), rotvec)
        assert torch.isfinite(grad).all(), angle


HUGE = [*POISON.astype(float), 1e150, 1e160, 1e300, -1.7e308]


@pytest.mark.parametrize("value", HUGE, ids=str)
@pytest.mark.parametrize("part", [0, 1, 2, slice(None)], ids=str)
def test_a_vertex_of_any_number_draws_numbers(value: float, part: int | slice) -> None:
    """A triangle with one bad corner, behind a sound one: it may not be drawn, the sound one always is."""
    xyz = np.array([[1.0, 1, 0], [1, 7, 0], [7, 1, 0], [0, 0, 1], [9, 0, 1], [0, 9, 1]])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    sound, _ = _core.rasterize_mesh(xyz, faces[:1], 9, 9)
    xyz[4, part] = value
    face, bary = _core.rasterize_mesh(xyz, faces, 9, 9)
    assert np.isfinite(bary).all()
    assert ((bary >= 0) & (bary <= 1 + 1e-9)).all()
    front = xyz[4, 2] >= 0 or not np.isfinite(xyz[4]).all()
    assert not front or (face[sound == 0] == 0).all()
    if not np.isfinite(value):
        assert np.array_equal(face, sound)
