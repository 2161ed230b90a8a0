"""A rig's landmarks with known expressions, seen by a camera, give the expressions back."""

import numpy as np
import pytest
from synthetic_face import NAMES, SIZE, landmark_head, seen

from cap4d.drive.face_solver import FaceSolver, lid_gains, look
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.track.landmark_sets import LEFT_LIDS, RIGHT_LIDS

NONE = np.zeros((478, 3))
EXPRESSIONS = (
    {"jawOpen": 0.8},
    {"mouthSmileLeft": 0.7, "browInnerUp": 0.5},
    {"mouthPucker": 0.6, "jawOpen": 0.3},
    {"eyeBlinkLeft": 0.25, "eyeBlinkRight": 0.25},
)


def solved(points, *, head=None, frames=3, size=SIZE):
    solver = FaceSolver(head or landmark_head())
    for _ in range(frames):
        face = solver(look(points, size, size), NONE)
    return face


def as_vector(expr):
    return np.array([expr.get(name, 0.0) for name in NAMES])


@pytest.mark.parametrize("expr", EXPRESSIONS, ids=lambda e: "+".join(e))
@pytest.mark.parametrize("rot", [(0, 0, 0), (0.2, -0.3, 0.1)], ids=["straight", "turned"])
def test_known_expressions_come_back(expr, rot):
    face = solved(seen(expr, rot=rot, tra=(0.03, -0.02, -0.45)))
    np.testing.assert_allclose(face.expr, as_vector(expr), atol=0.06)
    np.testing.assert_allclose(face.rotmat, axis_angle_to_rotmat(np.array(rot)), atol=0.02)
    np.testing.assert_allclose(face.tra, [0.03, -0.02, -0.45], atol=0.01)


@pytest.mark.parametrize("expr", EXPRESSIONS[:3], ids=lambda e: "+".join(e))
def test_expressions_of_a_rig_that_goes_both_ways_come_back(expr):
    turned = {name: -value if name == "browInnerUp" else value for name, value in expr.items()}
    face = solved(seen(turned), head=landmark_head(signed=True))
    np.testing.assert_allclose(face.expr, as_vector(turned), atol=0.12)


def test_place_size_and_roll_in_the_picture_change_nothing():
    expr = {"jawOpen": 0.5, "mouthSmileLeft": 0.4}
    plain = solved(seen(expr)).expr
    poses = ({"tra": (0.1, 0.08, -0.6)}, {"tra": (0, 0, -0.35)}, {"rot": (0, 0, 0.9)}, {"rot": (0, 0, -1.4)})
    for pose in poses:
        np.testing.assert_allclose(solved(seen(expr, **pose)).expr, plain, atol=0.03)
    larger = solved(2 * seen(expr), size=2 * SIZE)
    np.testing.assert_allclose(larger.expr, plain, atol=1e-6)


def test_noise_of_the_landmarks_stays_small():
    rng = np.random.default_rng(0)
    expr = {"jawOpen": 0.5, "browInnerUp": 0.6}
    found = [solved(seen(expr) + rng.normal(0, 0.4, (478, 2))).expr for _ in range(20)]
    assert np.abs(np.mean(found, 0) - as_vector(expr)).max() < 0.06
    assert np.std(found, 0).max() < 0.05


def test_a_few_landmarks_of_the_skin_that_are_far_off_do_little():
    points = seen({"jawOpen": 0.5})
    skin = np.setdiff1d(np.arange(468), [*RIGHT_LIDS, *LEFT_LIDS])
    points[np.random.default_rng(1).choice(skin, 12)] += 40
    np.testing.assert_allclose(solved(points, frames=6).expr, as_vector({"jawOpen": 0.5}), atol=0.05)


def test_bounds_hold():
    face = solved(seen({"jawOpen": 1.5, "mouthSmileLeft": -0.5}))
    assert face.expr.min() >= 0 and face.expr.max() == 1.0


def test_gaze_is_where_the_irises_are():
    face = solved(seen(gaze=(0.15, -0.2)))
    np.testing.assert_allclose(face.gaze, [0.15, -0.2], atol=0.02)
    shut = seen({"eyeBlinkLeft": 1, "eyeBlinkRight": 1}, gaze=(0.15, -0.2))
    np.testing.assert_allclose(solved(shut).gaze, 0, atol=1e-3)


def test_lids_shut_on_the_first_frame_of_a_blink():
    solver = FaceSolver(landmark_head())
    for _ in range(3):
        solver(look(seen(), SIZE, SIZE), NONE)
    shut = solver(look(seen({"eyeBlinkLeft": 0.75, "eyeBlinkRight": 0.75}), SIZE, SIZE), NONE)
    assert shut.expr[1:3].min() > 0.9  # landmarks of shut lids are still a little apart
    again = solver(look(seen(), SIZE, SIZE), NONE)
    assert again.expr[1:3].max() < 0.05


def test_a_wink_is_of_one_eye():
    face = solved(seen({"eyeBlinkLeft": 0.8}))
    assert face.expr[1] > 0.9 and face.expr[2] < 0.05


def test_gains_of_lids_grow_without_a_jump():
    rest = landmark_head().subject.neutral[:468].astype(float)
    opened = np.linspace(0, 1.2, 500)
    gains = np.array([lid_gains(rest, rest, np.full(2, o))[0] for o in opened])
    left = 1 - gains * (1 - opened)  # what the avatar's lids are open
    assert np.abs(np.diff(left)).max() < 0.01
    assert (np.diff(left) >= -1e-12).all() and left[opened < 0.3].max() <= 1e-9


@pytest.mark.parametrize(
    "points",
    [
        np.full((478, 2), np.nan),
        np.full((478, 2), np.inf),
        np.zeros((478, 2)),
        np.zeros((468, 2)),
        np.stack([np.arange(478.0), np.arange(478.0)], 1),
        seen(tra=(0, 0, -9.0)),
        np.full((478, 2), 1e300),
    ],
    ids=["nan", "inf", "a point", "too few", "a line", "too small", "too far"],
)
def test_what_is_no_face_is_told_apart(points):
    assert look(points, SIZE, SIZE) is None


def test_landmarks_in_disorder_are_no_face_and_do_no_harm():
    solver = FaceSolver(landmark_head())
    solver(look(seen(), SIZE, SIZE), NONE)
    disorder = np.random.default_rng(2).uniform(0, SIZE, (478, 2))
    sight = look(disorder, SIZE, SIZE)
    assert sight is None or solver(sight, NONE) is None
    for _ in range(3):
        face = solver(look(seen({"jawOpen": 0.5}), SIZE, SIZE), NONE)
    np.testing.assert_allclose(face.expr, as_vector({"jawOpen": 0.5}), atol=0.06)


def test_a_face_that_jumps_is_found_again():
    solver = FaceSolver(landmark_head())
    solver(look(seen(tra=(-0.1, 0, -0.5)), SIZE, SIZE), NONE)
    sight = look(seen({"jawOpen": 0.4}, tra=(0.15, 0.1, -0.8), rot=(0, 0, 1.0)), SIZE, SIZE)
    for _ in range(3):
        face = solver(sight, NONE)
    np.testing.assert_allclose(face.tra, [0.15, 0.1, -0.8], atol=0.02)
    np.testing.assert_allclose(face.expr, as_vector({"jawOpen": 0.4}), atol=0.06)
