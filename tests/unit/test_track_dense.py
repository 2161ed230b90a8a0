"""Frames that disagree about the skin are moved until they agree."""

from dataclasses import replace

import numpy as np
import pytest

from cap4d.camera import Camera, head_fixed, opencv_from_rig
from cap4d.mesh import shade
from cap4d.rotation import axis_angle_to_rotmat

for module in ("OpenImageIO", "torch", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from cap4d.track.dense import choose_points, normalised, refine  # noqa: E402
from cap4d.track.landmarks import N_LANDMARKS  # noqa: E402
from cap4d.track.solve import OVAL, Observations, Solution  # noqa: E402

FRAMES, SIZE, FOCAL = 6, 320, 410.0


def _freckled(rig):
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(3, 24)) * 400  # rad/m: spots of some millimetres
    spots = np.sin(rig.template @ waves + rng.uniform(0, 6, 24)).sum(1, keepdims=True) / 24**0.5
    return replace(rig, colors=np.clip(rig.colors * (0.7 + 0.2 * spots), 0, 1).astype(np.float32))


def _camera(solution, t):
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    return Camera(K, head_fixed(np.eye(4), solution.rot[t], solution.tra[t]), SIZE, SIZE)


@pytest.fixture(scope="module")
def scene(builtin_rig):
    """Frames of the freckled built-in head, the truth, and landmarks: arbitrary points, but for the oval."""
    rig = _freckled(builtin_rig)
    t = np.arange(FRAMES) / 4  # s, of slow motion
    zeros = np.zeros((FRAMES, 3))
    rot = np.stack([0.02 * np.sin(t), 0.06 * np.cos(t), 0 * t], 1)
    tra = np.stack([0.004 * np.sin(2 * t), 0.003 * np.cos(3 * t), -0.42 + 0 * t], 1)
    expr = np.zeros((FRAMES, rig.n_expressions))
    truth = Solution(np.zeros(rig.n_identity), expr, rot, tra, zeros, np.array([FOCAL]))
    world = opencv_from_rig(rig.template.astype(float))
    drawn = [shade(world, rig.faces, _camera(truth, i), colors=rig.colors) for i in range(FRAMES)]
    images = [np.uint8(255 * rgba[..., :3]) for rgba in drawn]
    front = np.flatnonzero((rig.template[:, 2] > 0.02) & (rig.skin_weights.sum(1) < 0.01))
    chosen = np.random.default_rng(1).choice(front, N_LANDMARKS)
    angle = np.linspace(0, 2 * np.pi, len(OVAL), endpoint=False)
    ring = np.stack([0.055 * np.sin(angle), 0.07 * np.cos(angle) - 0.01, 0 * angle + 0.04], 1)
    chosen[list(OVAL)] = front[np.argmin(np.linalg.norm(rig.template[front, None] - ring, axis=2), 0)]
    landmark_rig = rig.resample(np.stack([chosen] * 3, 1), np.tile([1.0, 0, 0], (N_LANDMARKS, 1)))
    points = np.stack([_camera(truth, i).project(world[chosen])[:, :2] for i in range(FRAMES)])
    sizes, cameras = np.full((FRAMES, 2), SIZE), np.zeros(FRAMES, int)
    observed = Observations(points, np.ones(FRAMES, bool), sizes, cameras, True)
    return rig, landmark_rig, observed, truth, images


def _misplaced(truth, solution):
    """[T] m: how far each frame's nose tip is from its place, beyond what all frames share."""
    nose = np.array([0, 0, 0.06])
    places = [axis_angle_to_rotmat(s.rot) @ nose + s.tra for s in (truth, solution)]
    off = places[1] - places[0]
    return np.linalg.norm((off - off.mean(0))[:, :2], axis=1)


def test_jitter_of_landmarks_is_undone_by_the_skin(scene):
    rig, landmark_rig, observed, truth, images = scene
    rng = np.random.default_rng(3)
    common = rng.normal(size=(FRAMES, 1, 2)) * 1.0  # all landmarks of a frame err together, as MediaPipe's do
    shaken = replace(truth, tra=truth.tra + np.pad(common[:, 0] * [1, -1], ((0, 0), (0, 1))) * 0.42 / FOCAL)
    noisy = replace(observed, points=observed.points + common)
    refined = refine(rig, landmark_rig, noisy, shaken, lambda t: images[t])
    before, after = _misplaced(truth, shaken), _misplaced(truth, refined)
    assert after.mean() < 0.6 * before.mean()


def test_points_lie_inside_the_outline_on_skin(scene, builtin_rig):
    rig, _, observed, truth, _ = scene
    points = choose_points(rig, observed, truth)
    place = (rig.template[points.vertices] * points.bary[..., None]).sum(1)
    assert len(place) > 1000
    seen = [_camera(truth, i).project(opencv_from_rig(place))[:, :2] for i in range(FRAMES)]
    oval = observed.points[:, list(OVAL)]
    inside = [(s > o.min(0) - 3).all(1) & (s < o.max(0) + 3).all(1) for s, o in zip(seen, oval, strict=True)]
    assert max(share.mean() for share in inside) == 1
    eyes = np.isin(points.vertices, builtin_rig.regions["eyes"]).any(1)
    assert not eyes.any()


def test_normalised_lightness_ignores_exposure():
    picture = np.random.default_rng(0).random((80, 80)).astype(np.float32)
    bright, dark = normalised(picture, 1.0, 10.0), normalised(0.6 * picture + 0.2, 1.0, 10.0)
    np.testing.assert_allclose(dark, bright, rtol=0.12, atol=0.02)
    assert np.abs(normalised(np.full((80, 80), 0.7, np.float32), 1.0, 10.0)).max() < 1e-3
