"""The user's hand over what plays."""

from dataclasses import replace

import numpy as np
import pytest
from cap4d.app.overrides import HEAD, Overrides
from tiny_bundle import tiny_bundle, tiny_clip

RANGES = np.float32([[0, 1], [0, 1], [-1, 1], [0.2, 1], [0, 2]])
FRAME = tiny_clip().frame(3)


@pytest.fixture
def overrides():
    return Overrides(RANGES)


def test_without_a_hand_the_frame_is_what_plays(overrides):
    assert overrides.apply(FRAME) is FRAME


def test_what_is_held_stays_and_the_rest_plays(overrides):
    overrides.hold(1, 0.5)
    expr = overrides.apply(FRAME).expr
    assert expr[1] == 0.5
    np.testing.assert_array_equal(np.delete(expr, 1), np.delete(FRAME.expr, 1))
    assert expr.dtype == np.float32
    overrides.let_go(1)
    assert overrides.apply(FRAME) is FRAME


def test_nothing_is_put_beyond_its_range(overrides):
    overrides.hold(0, 7.0)
    overrides.hold(3, -7.0)
    assert overrides.apply(FRAME).expr[[0, 3]] == pytest.approx([1, 0.2])


def test_rotations_are_held_too(overrides):
    overrides.hold_turn("eye_rot", np.array([0.1, 0.2, 0]))
    frame = overrides.apply(FRAME)
    np.testing.assert_allclose(frame.eye_rot, [0.1, 0.2, 0])
    np.testing.assert_array_equal(frame.neck_rot, FRAME.neck_rot)
    overrides.let_turn_go("eye_rot")
    assert overrides.count == 0


def test_every_change_is_a_new_version(overrides):
    seen = [overrides.version]
    changes = (
        lambda: overrides.hold(0, 1),
        lambda: overrides.let_go(0),
        overrides.neutral,
        lambda: overrides.randomize(np.random.default_rng(1)),
        lambda: overrides.hold_turn(HEAD, np.zeros(3)),
        lambda: overrides.let_turn_go(HEAD),
        overrides.reset,
    )
    for change in changes:
        change()
        seen.append(overrides.version)
    assert len(set(seen)) == len(changes) + 1


def test_the_neutral_face_is_as_near_to_zero_as_the_range_goes(overrides):
    overrides.neutral()
    assert overrides.apply(FRAME).expr == pytest.approx([0, 0, 0, 0.2, 0])


def test_random_faces_differ_and_stay_in_range(overrides):
    faces = []
    for seed in range(50):
        overrides.randomize(np.random.default_rng(seed))
        faces.append(overrides.apply(FRAME).expr)
    faces = np.array(faces)
    assert (faces >= RANGES[:, 0] - 1e-6).all()
    assert (faces <= RANGES[:, 1] + 1e-6).all()
    assert (faces.std(0) > 0.01).all()
    assert faces[:, 2].min() < 0 < faces[:, 2].max()


def test_a_turned_head_turns_about_its_middle(overrides):
    camera, centre = tiny_bundle(network=False).camera, np.array([0.01, -0.03, 0.02])
    assert overrides.turned(camera.viewmat, centre) is camera.viewmat
    overrides.hold_turn(HEAD, np.array([0.0, 0.5, 0.0]))
    turned = overrides.turned(camera.viewmat, centre)
    at = lambda viewmat, point: viewmat[:3, :3] @ point + viewmat[:3, 3]  # noqa: E731
    np.testing.assert_allclose(at(turned, centre), at(camera.viewmat, centre), atol=1e-9)
    nose = centre + np.array([0, 0, -0.1])  # towards the camera: OpenCV axes
    seen = replace(camera, viewmat=turned).project(nose)
    assert (
        seen[0] > camera.project(nose)[0] + 5
    )  # a positive turn about the rig's y looks to the image's right
