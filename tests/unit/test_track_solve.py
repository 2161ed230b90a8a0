"""Landmarks made from known parameters give those parameters back."""

from dataclasses import replace

import numpy as np
import pytest

from cap4d.camera import opencv_from_rig
from cap4d.rotation import axis_angle_to_rotmat

for module in ("OpenImageIO", "torch", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from cap4d.track.landmarks import N_LANDMARKS  # noqa: E402
from cap4d.track.solve import (  # noqa: E402
    GAPS,
    Observations,
    Weights,
    interpolate_invalid,
    reprojection_errors,
    solve,
)

FRAMES, SIZE, FOCAL = 9, 512, 660.0


@pytest.fixture(scope="module")
def points(builtin_rig):
    """The built-in head on 478 points at the front of the face, forty of them on a lid."""
    rng = np.random.default_rng(0)
    blink = builtin_rig.expression_names.index("eyeBlinkLeft")
    front = np.flatnonzero((builtin_rig.template[:, 2] > 0.02) & (builtin_rig.skin_weights.sum(1) < 0.01))
    chosen = rng.choice(front, N_LANDMARKS)
    moved = np.argsort(-np.abs(builtin_rig.expression_basis[blink][front]).sum(1))[:40]
    chosen[rng.choice(N_LANDMARKS - 10, 40, replace=False)] = front[moved]
    return builtin_rig.resample(np.stack([chosen] * 3, 1), np.tile([1.0, 0, 0], (N_LANDMARKS, 1)))


def _project(points, shape, expr, rot, tra):
    head = points.subject(np.float32(shape)).pose(np.float32(expr))
    world = opencv_from_rig(head.astype(float) @ axis_angle_to_rotmat(rot).T + tra)
    return world[:, :2] / world[:, 2:] * FOCAL + SIZE / 2


@pytest.fixture(scope="module")
def truth(points):
    rng = np.random.default_rng(1)
    t = np.arange(FRAMES)
    expr = np.zeros((FRAMES, points.n_expressions))
    expr[:, points.expression_names.index("jawOpen")] = 0.3 + 0.3 * np.sin(t / 3)
    expr[4, points.expression_names.index("eyeBlinkLeft")] = 1
    rot = np.stack([0.1 * np.sin(t / 5), 0.2 * np.cos(t / 6), 0 * t], 1)
    tra = np.stack([0.01 * np.sin(t / 4), 0.005 * np.cos(t / 4), -0.45 + 0 * t], 1)
    shape = rng.normal(size=points.n_identity) * 0.5
    landmarks = np.stack([_project(points, shape, expr[i], rot[i], tra[i]) for i in range(FRAMES)])
    return dict(shape=shape, expr=expr, rot=rot, tra=tra, landmarks=landmarks)


def _observed(landmarks, valid=None, known=None):
    valid = np.ones(FRAMES, bool) if valid is None else valid
    sizes, cameras = np.full((FRAMES, 2), SIZE), np.zeros(FRAMES, int)
    return Observations(landmarks, valid, sizes, cameras, True, known)


@pytest.fixture(scope="module")
def solved(points, truth):
    landmarks = truth["landmarks"].copy()
    landmarks[6] = 1e6
    landmarks[:, 5] += [40, -25]
    known = np.arange(N_LANDMARKS) != 5
    observations = _observed(landmarks, np.arange(FRAMES) != 6, known)
    return observations, interpolate_invalid(solve(points, observations), observations.valid)


def test_points_land_on_their_landmarks(points, solved):
    observations, solution = solved
    errors = reprojection_errors(points, observations, solution)
    assert np.nanmedian(errors) < 0.5
    assert np.isnan(errors[6]).all() and np.isnan(errors[:, 5]).all()


def test_pose_is_recovered(truth, solved):
    _, solution = solved
    turn = axis_angle_to_rotmat(solution.rot).swapaxes(-1, -2) @ axis_angle_to_rotmat(truth["rot"])
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() < 2.5
    np.testing.assert_allclose(np.diff(angle), 0, atol=0.5)  # what is left is one constant turn, not jitter
    scale = solution.tra[:, 2] / solution.focal[0] * FOCAL / truth["tra"][:, 2]
    np.testing.assert_allclose(scale, 1, atol=0.05)


def test_a_blink_of_one_frame_survives_smoothing(points, solved):
    _, solution = solved
    blink = solution.expr[:, points.expression_names.index("eyeBlinkLeft")]
    assert blink[4] > 0.75 and np.abs(blink[[0, 1, 2, 3, 5, 7, 8]]).max() < 0.12


def test_expressions_stay_in_their_range(points, solved):
    _, solution = solved
    low, high = points.expression_range.T
    assert (solution.expr > low - 0.06).all() and (solution.expr < high + 0.06).all()


def test_a_frame_without_a_face_is_interpolated(solved):
    _, solution = solved
    np.testing.assert_allclose(solution.rot[6], (solution.rot[5] + solution.rot[7]) / 2, atol=1e-9)


def test_landmark_noise_is_smoothed_in_pose(points, truth):
    noise = np.random.default_rng(2).normal(size=truth["landmarks"].shape) * 1.0
    observations = _observed(truth["landmarks"] + noise)
    smooth = solve(points, observations).rot
    rough = solve(points, replace(observations, continuous=False)).rot
    jerk = [np.abs(np.diff(rot - truth["rot"], 2, axis=0)).mean() for rot in (smooth, rough)]
    assert jerk[0] < 0.6 * jerk[1]


def test_gaps_name_landmarks():
    assert all(0 <= i < 468 for pair in GAPS for i in pair)
    assert Weights().gap > 0
