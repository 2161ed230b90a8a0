"""Landmarks find their place on an avatar by looking at it, as on the rig it was made of."""

import numpy as np
import pytest
from painted_bundle import painted_bundle

for module in ("cv2", "mediapipe"):
    pytest.importorskip(module, reason="needs OpenCV and mediapipe")

from cap4d.drive.landmark_head import find_landmark_head, gaussian_colors, grid_rig  # noqa: E402
from cap4d.errors import ArgumentError  # noqa: E402
from cap4d.track.correspondence import find_correspondence  # noqa: E402
from cap4d.track.landmark_sets import BROWS, INNER_LIPS, LEFT_LIDS, NOSE, OUTER_LIPS, RIGHT_LIDS  # noqa: E402
from cap4d.track.landmarks import without_native_chatter  # noqa: E402

PARTS = {"lids": RIGHT_LIDS + LEFT_LIDS, "brows": BROWS, "lips": OUTER_LIPS + INNER_LIPS, "nose": NOSE}


@pytest.fixture(scope="module")
def bundle(builtin_rig):
    return painted_bundle(builtin_rig)


@pytest.fixture(scope="module")
def head(bundle):
    with without_native_chatter():
        return find_landmark_head(bundle)


@pytest.fixture(scope="module")
def on_the_rig(builtin_rig):
    with without_native_chatter():
        return find_correspondence(builtin_rig).points(builtin_rig.template)


@pytest.mark.parametrize("part", PARTS)
def test_they_lie_where_they_lie_on_the_rig(part, head, on_the_rig):
    chosen = list(PARTS[part])
    assert head.known[chosen].mean() > 0.9
    gaps = np.linalg.norm(head.subject.neutral - on_the_rig, axis=1)[chosen]
    assert np.median(gaps) < 0.003 and np.quantile(gaps, 0.9) < 0.007  # m


def test_lips_part_and_lids_shut(head):
    subject = head.subject
    names = list(subject.expression_names)
    opened = subject.expression_basis[names.index("jawOpen"), :, 1]
    assert opened[[14, 87, 317]].max() < -0.01 < -0.005 < opened[[13, 82, 312]].min()
    for name, upper, lower in (("eyeBlinkLeft", 386, 374), ("eyeBlinkRight", 159, 145)):
        rest = subject.neutral[upper, 1] - subject.neutral[lower, 1]
        shut = subject.expression_basis[names.index(name), [upper, lower], 1]
        assert rest > 0.004 and abs(rest + shut[0] - shut[1]) < 0.35 * rest


def test_expressions_that_no_landmark_shows_stay_at_zero(head):
    names, reach = head.subject.expression_names, np.abs(head.expression_range).max(1)
    still = {name for name, far in zip(names, reach, strict=True) if far == 0}
    assert "tongueOut" in still and "jawForward" in still and "eyeLookDownLeft" in still
    moving = ("jawOpen", "eyeBlinkLeft", "mouthSmileRight", "mouthPucker", "browInnerUp", "mouthFunnel")
    assert not still & set(moving)


def test_the_right_eye_comes_first(head):
    assert head.eyes[0, 0] < -0.02 and head.eyes[1, 0] > 0.02
    assert head.subject.neutral[33, 0] < head.eyes[0, 0] < head.subject.neutral[133, 0]


def test_colours_are_those_of_the_gaussians(bundle, builtin_rig):
    colors = gaussian_colors(bundle)
    mixed = (builtin_rig.colors[bundle.grid.vertices] * bundle.grid.bary[..., None]).sum(1)
    assert np.median(np.abs(colors - mixed)) < 0.02


def test_the_grid_as_a_rig_poses_as_the_avatar_does(bundle):
    expr = np.full(bundle.n_expressions, 0.3, np.float32)
    rig = grid_rig(bundle, None)
    np.testing.assert_allclose(rig.subject().pose(expr), bundle.subject.pose(expr), atol=1e-6)


def test_an_avatar_without_a_face_is_refused():
    from tiny_avatar import tiny_rig

    with without_native_chatter(), pytest.raises(ArgumentError, match="expected an avatar with a face"):
        find_landmark_head(painted_bundle(tiny_rig()))
