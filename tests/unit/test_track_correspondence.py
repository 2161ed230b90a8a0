"""Landmarks find their place on any rig by looking at it."""

import numpy as np
import pytest

for module in ("OpenImageIO", "torch", "cv2", "mediapipe"):
    pytest.importorskip(module, reason="needs the extra [track] and mediapipe")

from cap4d.track.correspondence import (  # noqa: E402
    _barycentric,
    _nearest_pixels,
    find_correspondence,
    opening_expression,
    painted_eyes,
)
from cap4d.track.landmarks import without_native_chatter  # noqa: E402

MULTI_PIE = (
    *(168, 197, 5, 4, 75, 97, 2, 326, 305),  # the bridge and the bottom of the nose
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),  # lids
    *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181, 78, 82, 13, 312, 308, 317, 14, 87),  # lips
)
"""MediaPipe's landmarks nearest in meaning to numbers 27 to 67 of the 68 Multi-PIE landmarks."""


@pytest.fixture(scope="module")
def builtin(builtin_rig):
    with without_native_chatter():
        return find_correspondence(builtin_rig)


def test_every_landmark_is_found_on_the_face(builtin, builtin_rig):
    assert builtin.known.all()
    np.testing.assert_allclose(builtin.bary.sum(1), 1, atol=1e-6)
    place = builtin.points(builtin_rig.template)
    assert place[1, 2] > place[[234, 454], 2].max() + 0.05  # the nose is before the ears
    assert place[263, 0] - place[33, 0] > 0.07  # the left eye's outer corner is on the person's left


def test_lids_and_lips_lie_on_their_own_sides(builtin, builtin_rig):
    """Opening the mouth moves the lower lip's landmarks only, although closed the lips' coincide."""
    expr = opening_expression(builtin_rig, builtin)
    opened = builtin.points(builtin_rig.subject().pose(expr) - builtin_rig.template)[:, 1]
    assert opened[[14, 87, 317]].max() < -0.006 < -0.002 < opened[[13, 82, 312]].min()
    place = builtin.points(builtin_rig.template)[:, 1]
    assert (place[[159, 386]] > place[[145, 374]] + 0.004).all()


def test_irises_lie_on_the_eyeballs(builtin, builtin_rig):
    turned = builtin_rig.subject().pose(np.zeros(builtin_rig.n_expressions), eye_rot=np.array([0, 0.3, 0]))
    motion = np.linalg.norm(builtin.points(turned - builtin_rig.template), axis=1)
    assert motion[468:].min() > 0.002 and motion[:468].max() < 1e-6


def test_ict_agrees_with_its_published_landmarks(shared):
    from cap4d.rig.ict import import_ict

    rig = import_ict(shared / "ict" / "ict_facekit_light.npz")
    with without_native_chatter():
        place = find_correspondence(rig).points(rig.template)
    published = rig.template[rig.regions["landmarks"]][27:]
    places = np.delete(published, 6, 0) if len(published) != len(MULTI_PIE) else published
    apart = np.linalg.norm(place[list(MULTI_PIE)] - places, axis=1)
    assert np.median(apart) < 0.003 and np.percentile(apart, 90) < 0.008


def test_barycentric_projects_and_stays_inside():
    triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
    np.testing.assert_allclose(_barycentric(np.array([[0.25, 0.5, 3.0]]), triangle), [[0.25, 0.25, 0.5]])
    outside = _barycentric(np.array([[-1.0, 0.5, 0]]), triangle)
    assert (outside >= 0).all() and outside.sum() == pytest.approx(1)


def test_nearest_pixels():
    shown = np.zeros((10, 12), bool)
    shown[2, 3] = shown[8, 9] = True
    rows, columns, distance = _nearest_pixels(shown, np.array([[3.5, 2.5], [9.5, 6.5], [-4.0, 2.0]]))
    assert (rows[:2].tolist(), columns[:2].tolist()) == ([2, 8], [3, 9])
    np.testing.assert_allclose(distance, [0, 2, np.inf], atol=1e-3)


def test_painted_irises_look_forward(builtin_rig):
    colors = painted_eyes(builtin_rig)
    dark = builtin_rig.template[colors.max(1) < 0.2]
    assert len(dark) and dark[:, 2].min() > builtin_rig.joints[1, 2]
