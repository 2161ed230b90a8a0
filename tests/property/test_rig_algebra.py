"""What must hold of any rig: mixing commutes with blendshapes, torch agrees with NumPy, rotations stay
finite.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cap4d.rig.head import HeadRig, MouthPlacement

V, S, E = 7, 3, 4
DRIVERS = ("neck", "jaw", "eyes", "expr")


def random_rig(seed: int, *, shared_weights: bool = False) -> HeadRig:
    """A rig of random numbers, with every optional part, in float64; or one whose points all have the same
    weights.
    """
    rng = np.random.default_rng(seed)
    weights = rng.uniform(size=(V, 4))
    weights /= weights.sum(1, keepdims=True) * 1.2
    if shared_weights:
        weights[:] = weights[0]
    is_mouth = (np.arange(V) >= V - 2).astype(float)
    local = np.column_stack([rng.normal(size=(V, 3)) * is_mouth[:, None], is_mouth])
    return HeadRig(
        name="random",
        licence="CC0-1.0",
        template=rng.normal(size=(V, 3)),
        faces=np.array([[0, 1, 2]], np.int32),
        uvs=rng.uniform(size=(3, 2)),
        uv_faces=np.array([[0, 1, 2]], np.int32),
        identity_basis=rng.normal(size=(S, V, 3)) * (1 - is_mouth[:, None]),
        expression_basis=rng.normal(size=(E, V, 3)),
        expression_names=tuple("abcd"),
        expression_range=np.tile([0.0, 1.0], (E, 1)),
        joint_names=DRIVERS,
        joint_drivers=DRIVERS,
        joints=rng.normal(size=(4, 3)),
        joints_identity=rng.normal(size=(S, 4, 3)),
        joints_expression=rng.normal(size=(E, 4, 3)),
        skin_weights=weights,
        expr_rotation=rng.normal(size=(E, 3)),
        pose_basis=rng.normal(size=(36, V, 3)),
        pose_offset=rng.normal(size=(V, 3)),
        mouth=None
        if shared_weights
        else MouthPlacement(local, rng.normal(size=(2, 3)), rng.normal(size=(S, 2, 3))),
        colors=rng.uniform(size=(V, 3)),
        regions={"head": np.arange(V), "deformable": np.arange(3)},
    )


def random_pose(seed: int, *lead: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    names = ("eye_rot", "neck_rot", "jaw_rot")
    return {"expr": rng.normal(size=(*lead, E))} | {name: rng.normal(size=(*lead, 3)) for name in names}


def mixture(seed: int, n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Points on the skin and on the mouth, which is a piece of its own in any mesh."""
    rng = np.random.default_rng(seed)
    skin, mouth = rng.integers(0, V - 2, size=(n, 3)), rng.integers(V - 2, V, size=(n, 3))
    return np.where(np.arange(n)[:, None] % 3 == 0, mouth, skin), rng.dirichlet(np.ones(3), size=n)


@given(st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_mixing_commutes_with_identity_and_expression(seed):
    rig, (vertices, bary) = random_rig(seed), mixture(seed)
    shape, expr = np.random.default_rng(seed).normal(size=S), random_pose(seed)["expr"]
    rig = HeadRig(**{**vars(rig), "expr_rotation": np.zeros((E, 3)), "pose_basis": None})
    mesh = rig.subject(shape).pose(expr)
    expected = (mesh[vertices] * bary[..., None]).sum(1)
    np.testing.assert_allclose(rig.resample(vertices, bary).subject(shape).pose(expr), expected, atol=1e-6)
    np.testing.assert_allclose(rig.subject(shape).resample(vertices, bary).pose(expr), expected, atol=1e-6)


@given(st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_mixing_commutes_with_joints_where_weights_are_shared(seed):
    rig, (vertices, bary) = random_rig(seed, shared_weights=True), mixture(seed)
    subject, pose = rig.subject(np.random.default_rng(seed).normal(size=S)), random_pose(seed)
    expected = (subject.pose(**pose)[vertices] * bary[..., None]).sum(1)
    np.testing.assert_allclose(subject.resample(vertices, bary).pose(**pose), expected, atol=1e-9)


@pytest.mark.parametrize("lead", [(), (5,), (2, 3)])
def test_torch_is_numpy_with_any_batch(lead):
    torch = pytest.importorskip("torch")
    rig, pose = random_rig(0), random_pose(1, *lead)
    shape = np.random.default_rng(2).normal(size=S)
    expected = rig.subject(shape).pose(**pose)
    assert expected.shape == (*lead, V, 3)
    tensors = {name: torch.tensor(value) for name, value in pose.items()}
    found = rig.map(torch.tensor).subject(torch.tensor(shape)).pose(**tensors)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    one_by_one = rig.subject(shape).pose(**{name: value[(0,) * len(lead)] for name, value in pose.items()})
    np.testing.assert_allclose(expected[(0,) * len(lead)], one_by_one, atol=1e-12)


def test_no_rotation_is_a_zero_rotation():
    subject, expr = random_rig(3).subject(), random_pose(3)["expr"]
    zero = dict.fromkeys(("eye_rot", "neck_rot", "jaw_rot"), np.zeros(3))
    np.testing.assert_allclose(subject.pose(expr, **zero), subject.pose(expr), atol=1e-12)


@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.sampled_from([0.0, 1e-30, 1e-8, 1e-4, 1e-3, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi, 1e3]),
)
@settings(max_examples=60, deadline=None)
def test_pose_and_its_gradient_stay_finite(axis, angle):
    torch = pytest.importorskip("torch")
    turn = torch.tensor(np.array(axis) / np.linalg.norm(axis) * angle, requires_grad=True)
    subject = random_rig(4).map(torch.tensor).subject()
    expr = torch.zeros(E, dtype=torch.float64, requires_grad=True)
    posed = subject.pose(expr, eye_rot=turn, neck_rot=turn, jaw_rot=turn)
    (posed**2).sum().backward()
    assert posed.isfinite().all() and turn.grad.isfinite().all() and expr.grad.isfinite().all()


def test_a_joint_turns_rigidly_about_its_place():
    rig = random_rig(5, shared_weights=True)
    weights = np.zeros((V, 4))
    weights[:, 2] = 1
    rig = HeadRig(**{**vars(rig), "skin_weights": weights, "pose_basis": None, "pose_offset": None})
    subject, expr = rig.subject(), random_pose(5)["expr"]
    centre = subject.joints[2] + np.tensordot(expr, subject.joints_expression[:, 2], 1)
    still = subject.pose(expr) - centre
    turned = subject.pose(expr, eye_rot=np.array([0.3, -0.5, 0.1])) - centre
    np.testing.assert_allclose(turned @ turned.T, still @ still.T, atol=1e-9)


def test_short_and_long_identities():
    rig = random_rig(6)
    shape = np.array([0.5, -1.0, 0.0])
    np.testing.assert_array_equal(rig.subject(shape[:2]).neutral, rig.subject(shape).neutral)
    np.testing.assert_array_equal(rig.subject(np.append(shape, [9, 9])).neutral, rig.subject(shape).neutral)
