"""Landmark metrics on frames of a real person, changed by a known amount."""

from __future__ import annotations

import numpy as np
import pytest

for module in ("OpenImageIO", "cv2", "mediapipe"):
    pytest.importorskip(module, reason="needs the extra [track] and mediapipe")

from cap4d.evaluate.faces import FaceFinder  # noqa: E402
from cap4d.evaluate.metrics.blink import BlinkError  # noqa: E402
from cap4d.evaluate.metrics.gaze import GazeError  # noqa: E402
from cap4d.evaluate.metrics.keypoints import KeypointDistance  # noqa: E402
from cap4d.evaluate.pair import Pair  # noqa: E402

SHIFTS = ((4, 0), (0, -7), (12, 9))


@pytest.fixture(scope="module")
def finder():
    with FaceFinder() as found:
        yield found


@pytest.fixture(scope="module")
def frames(shared):
    """float32[512, 512, 3] of the talking head, by number."""
    from cap4d.track.footage import open_footage

    wanted = {}
    for number, frame in enumerate(open_footage(shared / "video" / "talking_head.mp4").frames()):
        if number in (0, 60, 120):
            wanted[number] = (frame / 255).astype(np.float32)
        if number == 120:
            return wanted


def shifted(image: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """What leaves the image on one side is repeated on the other."""
    rows = np.clip(np.arange(len(image)) - dy, 0, len(image) - 1)
    columns = np.clip(np.arange(image.shape[1]) - dx, 0, image.shape[1] - 1)
    return image[rows][:, columns]


@pytest.mark.parametrize(("dx", "dy"), SHIFTS)
def test_a_face_that_is_shifted_by_k_px_has_a_keypoint_distance_of_k(frames, finder, dx, dy):
    for image in frames.values():
        pair = Pair(shifted(image, dx, dy), image, finder=finder)
        assert KeypointDistance().measure(pair) == pytest.approx(np.hypot(dx, dy), abs=0.5)
        assert GazeError().measure(pair) < 1.5  # MediaPipe's noise is 0.7
        assert BlinkError().measure(pair) < 0.015


def test_distances_are_said_for_images_of_512_px(frames, finder):
    image = frames[0]
    small = image.reshape(256, 2, 256, 2, 3).mean((1, 3), dtype=np.float32)
    pair = Pair(shifted(small, 6, 0), small, finder=finder)
    assert KeypointDistance().measure(pair) == pytest.approx(12, abs=0.7)


def test_another_moment_differs_and_the_same_does_not(frames, finder):
    for metric in (KeypointDistance(), GazeError(), BlinkError()):
        same = Pair(frames[0], frames[0].copy(), finder=finder)
        assert metric.measure(same) == pytest.approx(0, abs=1e-9)
        assert metric.measure(Pair(frames[120], frames[0], finder=finder)) > 0
    assert KeypointDistance().measure(Pair(frames[120], frames[0], finder=finder)) > 5


def test_where_no_face_is_nothing_is_measured(frames, finder):
    blank = np.ones_like(frames[0])
    pair = Pair(blank, frames[0], finder=finder)
    assert pair.faces.image is None and pair.faces.truth is not None
    assert KeypointDistance().measure(pair) is None


def test_networks_get_the_face_upright_and_where_they_want_it(frames, finder):
    """What each network is given: MediaPipe finds the eyes there where that network's training had them."""
    from cap4d.evaluate.metrics.csim import PLACES, POINTS, aligned_face
    from cap4d.evaluate.metrics.fan import face_square
    from cap4d.evaluate.metrics.flame import face_box
    from cap4d.evaluate.metrics.warp import cut

    for image in (frames[0], np.ascontiguousarray(frames[0][::-1, ::-1])):  # the other stands on its head
        points = finder.find(frames[0])
        if image is not frames[0]:
            points = [512, 512] - points
        seen = finder.find(aligned_face(image, points))
        five = np.stack([seen[list(group)].mean(0) for group in POINTS])
        np.testing.assert_allclose(five, PLACES, atol=5)
    points = finder.find(frames[0])
    for affine, size, share in ((face_box(points), 224, 0.73), (face_square(points), 256, 0.49)):
        seen = finder.find(cut(frames[0], affine, size))
        assert np.ptp(seen[:, 0]) / size == pytest.approx(share, abs=0.08)


def test_an_avatar_without_a_face_has_no_tracked_expression():
    from tiny_bundle import tiny_bundle

    from cap4d.evaluate.metrics.metric import NotMeasured
    from cap4d.evaluate.metrics.registry import metrics_available
    from cap4d.evaluate.metrics.weights import Weights

    found = metrics_available(Weights(), bundle=tiny_bundle(network=False), only=["AED-mp", "APD-mp"])
    assert all(isinstance(metric, NotMeasured) for metric in found)
    assert "MediaPipe sees a face" in found[0].needs
