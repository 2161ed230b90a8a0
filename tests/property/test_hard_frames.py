"""An avatar driven far beyond its range: every frame is finite, and the next one as if nothing had been."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("onnx")

from hypothesis import given, settings
from hypothesis import strategies as st
from parity import tolerances as tol
from tiny_bundle import EXPRESSIONS, tiny_bundle

from cap4d.bundle import Bundle
from cap4d.camera import Camera
from cap4d.errors import DataError
from cap4d.gaussians import Gaussians
from cap4d.player.avatar import Avatar
from cap4d.render import render

BUNDLE = tiny_bundle(size=12)
ZERO = np.zeros(len(EXPRESSIONS), np.float32)
TURNS = [0.0, 1e-45, 1e-20, 1e-4, np.pi - 1e-6, np.pi, 2 * np.pi, 1e3, 1e6]


@pytest.fixture(scope="module", params=["full", "off"])
def avatar(request: pytest.FixtureRequest) -> Avatar:
    return Avatar(BUNDLE, deformer=request.param)


def check(avatar: Avatar, gaussians: Gaussians, camera: Camera | None = None) -> None:
    """Everything is finite, and the same for one and two threads."""
    assert all(np.isfinite(getattr(gaussians, n)).all() for n in ("means", "quats", "scales", "opacities"))
    one, two = (render(gaussians, camera or avatar.camera, threads=threads) for threads in (1, 2))
    for name in ("rgb", "alpha", "depth"):
        assert np.isfinite(getattr(one, name)).all(), name
        assert np.array_equal(getattr(one, name), getattr(two, name)), name


def check_frame(avatar: Avatar, expr: np.ndarray, **rotations: np.ndarray) -> None:
    """The player's own picture of it, made by the prepared splatter, is that of the posed Gaussians."""
    frame = avatar.render(expr, background=(1.0, 1.0, 1.0), **rotations)
    exact = render(avatar.pose(expr, **rotations), avatar.camera).rgb.clip(0, 1) * 255
    steps = np.abs(frame[..., :3] - exact)
    assert (steps > tol.PLAYER_PICTURE).mean() <= tol.FLIP_SHARE


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), corner=st.booleans())
def test_expressions_at_ten_times_their_range(avatar: Avatar, seed: int, corner: bool) -> None:
    rng = np.random.default_rng(seed)
    low, high = BUNDLE.expression_range.T
    share = rng.integers(0, 2, len(ZERO)) if corner else rng.uniform(size=len(ZERO))
    expr = (10 * (low + share * (high - low)) * rng.choice([-1, 1], len(ZERO))).astype(np.float32)
    before = avatar.render(ZERO)
    check(avatar, avatar.pose(expr))
    check_frame(avatar, expr)
    assert np.abs(avatar.vertices(expr)).max() < 10, "a head of more than 10 m"
    assert np.array_equal(avatar.render(ZERO), before)


@settings(max_examples=40, deadline=None)
@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angles=st.tuples(*[st.sampled_from(TURNS)] * 3),
)
def test_any_turn_of_eyes_neck_and_jaw(avatar: Avatar, axis: tuple, angles: tuple) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    eye, neck, jaw = (np.float32(unit * angle) for angle in angles)
    check(avatar, avatar.pose(ZERO, eye_rot=eye, neck_rot=neck, jaw_rot=jaw))
    check_frame(avatar, ZERO, eye_rot=eye, neck_rot=neck, jaw_rot=jaw)


@pytest.mark.parametrize("value", [1e-45, 1e-38, 1e4, 1e10, 1e20, 3e38])
def test_any_expression_is_drawn_or_refused(avatar: Avatar, value: float) -> None:
    """Far beyond sense the network may have no answer; it says so, and the next frame is as before."""
    before = avatar.render(ZERO)
    expr = np.full(len(ZERO), value, np.float32)
    try:
        with np.errstate(all="ignore"):
            frame = render(avatar.pose(expr), avatar.camera)
    except DataError as error:
        assert avatar.deformer is not None and "finite" in str(error)
    else:
        assert np.isfinite(frame.rgb).all() and np.isfinite(frame.depth).all()
    assert np.array_equal(avatar.render(ZERO), before)


def flat(bundle: Bundle, share: float) -> Bundle:
    """The same head with its rows drawn together, as closed eyelids are; at 0 no triangle has an area."""
    neutral = bundle.subject.neutral.copy()
    neutral[:, 1] *= np.float32(share)
    return replace(bundle, subject=replace(bundle.subject, neutral=neutral))


@pytest.mark.parametrize("share", [0.0, 1e-30, 1e-7, 1e-3])
def test_a_head_without_height(share: float) -> None:
    subject = flat(BUNDLE, share)
    avatar = Avatar(subject, deformer="off")
    check(avatar, avatar.pose(ZERO))


@pytest.mark.parametrize("field", ["means", "quats", "log_scales", "opacity_logits", "sh"])
@pytest.mark.parametrize(
    "value", [0.0, -0.0, 1e-45, 1e-38, 100.0, 65520.0, 1e19, 3e38, np.nan, np.inf, -np.inf]
)
def test_a_bad_gaussian_takes_itself_at_most(field: str, value: float) -> None:
    """Within the program (files with such numbers are refused, see test_hostile_bundle)."""
    array = getattr(BUNDLE, field).copy()
    array[5] = value
    kept = {
        n: np.delete(getattr(BUNDLE, n), 5, 0)
        for n in ("means", "quats", "log_scales", "opacity_logits", "sh", "binding")
    }
    with np.errstate(all="ignore"):
        bad = Avatar(replace(BUNDLE, **{field: array}), deformer="off").pose(ZERO)
        found = render(bad, BUNDLE.camera)
    without = render(Avatar(replace(BUNDLE, **kept), deformer="off").pose(ZERO), BUNDLE.camera)
    assert np.isfinite(found.rgb).all() and np.isfinite(found.depth).all()
    if not np.isfinite(value) and (field, value) not in (
        (("opacity_logits", np.inf)),
        ("log_scales", -np.inf),
    ):
        assert np.array_equal(found.rgb, without.rgb)
