"""Each metric on pictures and landmarks whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

for module in ("OpenImageIO", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from looked_at import GivenFaces, faced_pair, soft_noise, write_network  # noqa: E402
from synthetic_face import NAMES, landmark_head, seen  # noqa: E402

from cap4d.errors import ArgumentError, DataError  # noqa: E402
from cap4d.evaluate.metrics import csim, flame, lpips  # noqa: E402
from cap4d.evaluate.metrics.blink import BlinkError  # noqa: E402
from cap4d.evaluate.metrics.csim import IdentitySimilarity, aligned_face  # noqa: E402
from cap4d.evaluate.metrics.eyes import EYES, IRISES, aspect_ratios, iris_diameters  # noqa: E402
from cap4d.evaluate.metrics.fan import FanDistance, peaks  # noqa: E402
from cap4d.evaluate.metrics.flame import ExpressionDistance, FlameRegressor, PoseDistance  # noqa: E402
from cap4d.evaluate.metrics.gaze import GazeError  # noqa: E402
from cap4d.evaluate.metrics.jod import JustObjectionableDifference  # noqa: E402
from cap4d.evaluate.metrics.keypoints import IBUG_68, KeypointDistance  # noqa: E402
from cap4d.evaluate.metrics.psnr import PersonPsnr, Psnr  # noqa: E402
from cap4d.evaluate.metrics.registry import METRIC_NAMES, metrics_available  # noqa: E402
from cap4d.evaluate.metrics.ssim import Ssim  # noqa: E402
from cap4d.evaluate.metrics.tracked import (  # noqa: E402
    ExpressionSolver,
    TrackedExpressionDistance,
    TrackedPoseDistance,
)
from cap4d.evaluate.metrics.warp import cut, similarity  # noqa: E402
from cap4d.evaluate.metrics.weights import Weights  # noqa: E402
from cap4d.evaluate.pair import MIN_SIDE, Pair  # noqa: E402
from cap4d.evaluate.protocols.gains import HIGHER  # noqa: E402

FACE_METRICS = (KeypointDistance(), GazeError(), BlinkError())


def blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    import cv2

    return cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image


def shifted(image: np.ndarray, dx: int) -> np.ndarray:
    return np.roll(image, dx, 1)


# Pairs


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((0, 0, 3), np.float32),
        np.zeros((MIN_SIDE - 1, 64, 3), np.float32),
        np.zeros((64, 64), np.float32),
        np.zeros((64, 64, 4), np.float32),
        np.zeros((64, 64, 3), np.uint8),
        np.full((64, 64, 3), np.nan, np.float32),
        np.full((64, 64, 3), 1.01, np.float32),
        np.full((64, 64, 3), -0.01, np.float32),
    ],
    ids=["empty", "tiny", "grey", "alpha", "uint8", "nan", "bright", "negative"],
)
def test_what_is_no_picture_is_refused(wrong):
    right = np.zeros((64, 64, 3), np.float32)
    with pytest.raises(ArgumentError, match=r"^image: expected"):
        Pair(wrong, right)
    with pytest.raises(ArgumentError, match=r"^truth: expected"):
        Pair(right, wrong)


def test_pictures_of_two_sizes_and_a_foreign_matte_are_refused():
    small, large = np.zeros((32, 32, 3), np.float32), np.zeros((32, 48, 3), np.float32)
    with pytest.raises(ArgumentError, match="as the truth"):
        Pair(small, large)
    with pytest.raises(ArgumentError, match="coverage"):
        Pair(small, small, coverage=np.ones((32, 48)))


def test_a_pair_without_a_finder_has_no_faces():
    image = soft_noise()
    with pytest.raises(ArgumentError, match="face finder"):
        _ = Pair(image, image).faces


def test_faces_are_looked_for_once():
    points = seen()
    pair = Pair(soft_noise(), soft_noise(), finder=GivenFaces(points, points))
    assert pair.faces is pair.faces
    assert KeypointDistance().measure(pair) == 0


# PSNR, SSIM


@pytest.mark.parametrize(("metric", "best"), [(Psnr(), 100.0), (Ssim(), 1.0)])
@pytest.mark.parametrize(
    "image", [soft_noise(), np.zeros((16, 16, 3), np.float32), np.ones((16, 40, 3), np.float32)]
)
def test_a_picture_is_like_itself(metric, best, image):
    assert metric.measure(Pair(image, image)) == pytest.approx(best)


@pytest.mark.parametrize("metric", [Psnr(), Ssim()])
@pytest.mark.parametrize("harm", [blurred, shifted])
def test_more_harm_is_worse(metric, harm):
    image = soft_noise(96)
    values = [metric.measure(Pair(harm(image, amount), image)) for amount in (0, 1, 2, 3)]
    assert values == sorted(values, reverse=True)
    assert len(set(values)) == 4


@pytest.mark.parametrize("metric", [Psnr(), Ssim()])
def test_it_does_not_matter_which_is_the_truth_nor_how_both_lie(metric):
    image, truth = soft_noise(seed=1), soft_noise(seed=2)
    value = metric.measure(Pair(image, truth))
    assert metric.measure(Pair(truth, image)) == pytest.approx(value)
    assert metric.measure(Pair(image[:, ::-1], truth[:, ::-1])) == pytest.approx(value)
    assert metric.measure(Pair(image[..., ::-1], truth[..., ::-1])) == pytest.approx(value)


def test_psnr_of_a_known_error_and_of_black_against_white():
    grey = np.full((32, 32, 3), 0.5, np.float32)
    assert Psnr().measure(Pair(grey + np.float32(0.1), grey)) == pytest.approx(20, abs=1e-4)
    assert Psnr().measure(Pair(np.zeros_like(grey), np.ones_like(grey))) == 0


def test_the_persons_psnr_looks_at_the_person_only():
    truth = soft_noise()
    coverage = np.zeros((64, 64), np.float32)
    coverage[:, :32] = 1
    image = truth.copy()
    image[:, 32:] = 0
    assert PersonPsnr().measure(Pair(image, truth, coverage=coverage)) == pytest.approx(100)
    assert Psnr().measure(Pair(image, truth)) < 20
    assert PersonPsnr().measure(Pair(image, truth)) is None
    assert PersonPsnr().measure(Pair(image, truth, coverage=np.zeros((64, 64)))) is None


# AKD, gaze, blink


@pytest.mark.parametrize("metric", FACE_METRICS, ids=lambda m: m.name)
def test_a_face_is_like_itself_and_a_lost_one_is_not_measured(metric):
    points = seen({"jawOpen": 0.3})
    assert metric.measure(faced_pair(points, points)) == pytest.approx(0, abs=1e-6)
    for image, truth in ((None, points), (points, None), (None, None)):
        assert metric.measure(faced_pair(image, truth)) is None


def test_the_68_points_are_distinct_and_those_of_a_face():
    assert len(IBUG_68) == len(set(IBUG_68)) == 68
    points = seen()[list(IBUG_68)]
    assert points[8, 1] == points[:, 1].max()  # the chin
    # All but the ridge and the base of the nose and the lips' middles come in pairs about the face's middle.
    mirrored = seen()[list(IBUG_68[:17])][::-1]
    middle = (points[:17, 0] + mirrored[:, 0]) / 2
    np.testing.assert_allclose(middle, middle[0], atol=2)


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (1, 0), (3, 4), (-6, 8)])
def test_a_shift_of_k_px_is_a_keypoint_distance_of_k(dx, dy):
    points = seen()
    distance = KeypointDistance().measure(faced_pair(points + [dx, dy], points))
    assert distance == pytest.approx(np.hypot(dx, dy))
    assert KeypointDistance().measure(faced_pair(points + [dx, dy], points, size=256)) == pytest.approx(
        2 * np.hypot(dx, dy)
    )


@pytest.mark.parametrize("metric", FACE_METRICS[1:], ids=lambda m: m.name)
def test_eyes_are_measured_where_they_are_however_the_face_lies(metric):
    image, truth = with_eyes(open_=0.9, look=(0.1, 0.05)), with_eyes(open_=1.0, look=(0, 0))
    value = metric.measure(faced_pair(image, truth))
    assert value > 0
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    for move in (lambda p: p + [40, -20], lambda p: 1.7 * p, lambda p: p @ turn.T):
        assert metric.measure(faced_pair(move(image), move(truth))) == pytest.approx(value, rel=1e-6)


def with_eyes(*, open_: float = 1.0, look: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Landmarks with eyes 30 px wide, 9 px high at rest, and irises of 11.7 px that look `look` rad aside and
    down: so an eyeball's radius is 12 px.
    """
    points = np.zeros((478, 2))
    for (a, b, c, d, e, f), iris, x in zip(EYES, IRISES, (180, 260), strict=True):
        middle = np.array([x, 200.0])
        high = 4.5 * open_
        places = [(-15, 0), (-5, -high), (5, -high), (15, 0), (5, high), (-5, high)]
        points[[a, b, c, d, e, f]] = middle + places
        centre = middle + 12 * np.sin(look)
        points[list(iris)] = centre + 5.85 * np.array([(0, 0), (1, 0), (0, -1), (-1, 0), (0, 1)])
    return points


def test_the_gaze_error_is_the_angle():
    straight = with_eyes()
    np.testing.assert_allclose(iris_diameters(straight), 11.7)
    for degrees in (1.0, 10.0, 25.0):
        aside = with_eyes(look=(np.radians(degrees), 0))
        assert GazeError().measure(faced_pair(aside, straight)) == pytest.approx(degrees, rel=1e-6)
        down = with_eyes(look=(0, np.radians(degrees)))
        assert GazeError().measure(faced_pair(down, straight)) == pytest.approx(degrees, rel=1e-6)


def test_shut_eyes_have_no_gaze():
    shut = with_eyes(open_=0.3)
    assert GazeError().measure(faced_pair(shut, with_eyes())) is None
    assert GazeError().measure(faced_pair(with_eyes(), shut)) is None
    wink = with_eyes(look=(0.1, 0))
    wink[list(EYES[0])] = shut[list(EYES[0])]
    assert GazeError().measure(faced_pair(wink, with_eyes())) == pytest.approx(np.degrees(0.1), rel=1e-6)


def test_the_blink_error_is_of_heights_over_widths():
    np.testing.assert_allclose(aspect_ratios(with_eyes()), 0.3)
    values = [BlinkError().measure(faced_pair(with_eyes(open_=o), with_eyes())) for o in (1, 0.8, 0.5, 0)]
    np.testing.assert_allclose(values, [0, 0.06, 0.15, 0.3], atol=1e-9)


# AED-mp, APD-mp


@pytest.fixture
def solver(monkeypatch):
    monkeypatch.setattr("cap4d.drive.landmark_head.find_landmark_head", lambda _: landmark_head())
    return ExpressionSolver(None)


def test_expressions_of_a_known_difference(solver):
    metric = TrackedExpressionDistance(solver)
    truth = seen({"jawOpen": 0.3})
    assert metric.measure(faced_pair(truth, truth)) == 0
    values = [
        metric.measure(faced_pair(seen({"jawOpen": weight}), truth, size=480)) for weight in (0.4, 0.6, 0.9)
    ]
    assert values == sorted(values)
    assert values[2] == pytest.approx(0.6 / len(NAMES), abs=0.02)


def test_poses_of_a_known_turn(solver):
    metric = TrackedPoseDistance(solver)
    truth = seen()
    assert metric.measure(faced_pair(truth, truth, size=480)) == pytest.approx(0, abs=1e-6)
    for turn in (0.05, 0.2):
        value = metric.measure(faced_pair(seen(rot=(0, turn, 0)), truth, size=480))
        assert value == pytest.approx(np.degrees(turn), abs=0.6)
    rolled = metric.measure(faced_pair(seen(rot=(0, 0, 0.3)), truth, size=480))
    assert rolled == pytest.approx(np.degrees(0.3), abs=0.6)


def test_one_solution_serves_both_and_none_is_none(solver):
    pair = faced_pair(seen(), seen(), size=480)
    assert solver(pair) is solver(pair)
    assert solver(faced_pair(None, seen())) is None
    far = np.zeros((478, 2))
    assert solver(faced_pair(far, seen(), size=480)) is None  # all in one point: no face


# AKD-fan


def test_fans_points_are_where_its_heatmaps_are_highest(tmp_path):
    """A network whose heatmaps all are the image, averaged over 4 px: one bright spot is every point."""
    metric = FanDistance(write_heatmaps(tmp_path / "fan.onnx"))
    landmarks = np.array([[100.0, 100.0], [200.0, 240.0]])  # the box is all that is looked at
    truth, image = spot(150, 160), spot(162, 155)
    pair = Pair(image, truth, finder=GivenFaces(landmarks, landmarks))
    cell = 200 * 240 / 195 / 64  # px of a heatmap's cell
    assert metric.measure(pair) == pytest.approx(2 * np.hypot(12, 5), abs=2 * cell)
    assert metric.measure(Pair(truth, truth, finder=GivenFaces(landmarks, landmarks))) == 0
    assert metric.measure(Pair(truth, truth, finder=GivenFaces(None, landmarks))) is None


def test_a_network_with_other_heatmaps_is_refused(tmp_path):
    path = write_heatmaps(tmp_path / "fan.onnx", points=98)
    landmarks = np.array([[100.0, 100.0], [200.0, 240.0]])
    with pytest.raises(DataError, match=r"expected float32\[1, 68, 64, 64\], found \[1, 98, 64, 64\]"):
        FanDistance(path).measure(Pair(spot(9, 9), spot(9, 9), finder=GivenFaces(landmarks, landmarks)))


def test_a_peak_leans_to_its_higher_neighbour():
    maps = np.zeros((3, 8, 8), np.float32)
    maps[:, 4, 5] = 1
    maps[1, 4, 6], maps[1, 3, 5] = 0.5, 0.2
    maps[2] = 0
    maps[2, 0, 7] = 1  # in the corner, with neighbours on one side only
    np.testing.assert_allclose(peaks(maps), [[5.5, 4.5], [5.75, 4.25], [7.75, 0.25]])


def spot(x: float, y: float) -> np.ndarray:
    """A bright spot in a dark picture of 256."""
    rows, columns = np.indices((256, 256)) + 0.5
    bright = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 5.0**2))
    return np.repeat(bright[..., None], 3, -1).astype(np.float32)


def write_heatmaps(path: Path, *, points: int = 68) -> Path:
    import onnx
    from onnx import numpy_helper
    from onnx.helper import make_graph, make_model, make_node, make_opsetid, make_tensor_value_info

    kernel = numpy_helper.from_array(np.full((points, 3, 4, 4), 1 / 48, np.float32), "kernel")
    node = make_node("Conv", ["input", "kernel"], ["maps"], strides=[4, 4])
    values = [
        make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)
        for name, shape in (("input", [1, 3, 256, 256]), ("maps", [1, points, 64, 64]))
    ]
    graph = make_graph([node], "fan", values[:1], values[1:], [kernel])
    onnx.save(make_model(graph, opset_imports=[make_opsetid("", 18)], ir_version=8), path)
    return path


# CSIM


def points_at(places: np.ndarray) -> np.ndarray:
    points = np.zeros((478, 2))
    for group, place in zip(csim.POINTS, places, strict=True):
        points[list(group)] = place
    return points


def test_the_face_is_cut_out_where_arcface_wants_it():
    image = soft_noise(112)
    np.testing.assert_allclose(aligned_face(image, points_at(csim.PLACES)), image, atol=1e-5)
    turn = np.array([[0, -1], [1, 0]])  # by a quarter: exact on pixels
    turned = np.rot90(image, -1).copy()
    moved = csim.PLACES @ turn.T + [112, 0]
    np.testing.assert_allclose(aligned_face(turned, points_at(moved)), image, atol=1e-4)


def test_similarity_brings_points_home():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5, 2))
    cos, sin = 1.3 * np.cos(0.4), 1.3 * np.sin(0.4)
    target = points @ np.array([[cos, -sin], [sin, cos]]).T + [3, -2]
    affine = similarity(points, target)
    np.testing.assert_allclose(points @ affine[:, :2].T + affine[:, 2], target, atol=1e-12)
    mirrored = similarity(points, points * [-1, 1])
    assert np.linalg.det(mirrored[:, :2]) > 0


def test_a_cut_that_shrinks_averages():
    image = np.zeros((256, 256, 3), np.float32)
    image[::2] = 1  # rows black and white: any that skips pixels sees one of them
    small = cut(image, np.array([[0.125, 0, 0], [0, 0.125, 0.0]]), 32)
    np.testing.assert_allclose(small[2:-2, 2:-2], 0.5, atol=0.02)


def test_csim_of_the_same_and_of_another_face(tmp_path):
    metric = IdentitySimilarity(write_network(tmp_path / "face.onnx", {"id": 512}, size=112))
    points = points_at(csim.PLACES)
    image, other = soft_noise(112, seed=1), soft_noise(112, seed=2)
    same = Pair(image, image, finder=GivenFaces(points, points))
    assert metric.measure(same) == pytest.approx(1)
    pair = Pair(other, image, finder=GivenFaces(points, points))
    assert -1 <= metric.measure(pair) < 0.9
    lost = Pair(other, image, finder=GivenFaces(None, points))
    assert metric.measure(lost) is None


def test_csim_follows_a_face_that_moved(tmp_path):
    metric = IdentitySimilarity(write_network(tmp_path / "face.onnx", {"id": 512}, size=112))
    image = np.full((160, 160, 3), 0.5, np.float32)
    image[20:132, 10:122] = soft_noise(112)
    moved = np.roll(image, (15, 30), (0, 1))
    points = points_at(csim.PLACES + [10, 20])
    pair = Pair(moved, image, finder=GivenFaces(points + [30, 15], points))
    assert metric.measure(pair) == pytest.approx(1, abs=1e-6)


# AED, APD


@pytest.mark.parametrize("outputs", [{"params": 236}, {"pose_params": 3, "expression_params": 50, "cam": 3}])
def test_expression_and_pose_of_a_regressor(tmp_path, outputs):
    regressor = FlameRegressor(write_network(tmp_path / "flame.onnx", outputs, size=224))
    metrics = ExpressionDistance(regressor), PoseDistance(regressor)
    points = np.random.default_rng(0).uniform(20, 100, (478, 2))
    image, truth = soft_noise(128, seed=1), soft_noise(128, seed=2)
    same = Pair(image, image, finder=GivenFaces(points, points))
    different = Pair(image, truth, finder=GivenFaces(points, points))
    milder = Pair(truth + (image - truth) / 2, truth, finder=GivenFaces(points, points))
    lost = Pair(image, truth, finder=GivenFaces(points, None))
    for metric in metrics:
        assert metric.measure(same) == 0
        value = metric.measure(different)
        assert value > 0
        assert metric.measure(milder) == pytest.approx(value / 2, rel=1e-3)  # the network is linear
        assert metric.measure(lost) is None


def test_the_regressor_sees_the_face_however_large(tmp_path):
    regressor = FlameRegressor(write_network(tmp_path / "flame.onnx", {"params": 236}, size=224))
    points = np.random.default_rng(0).uniform(60, 100, (478, 2))
    image = blurred(soft_noise(160), 3)
    doubled = np.repeat(np.repeat(image, 2, 0), 2, 1)
    small = regressor(Pair(image, image, finder=GivenFaces(points, points)))[0]
    large = regressor(Pair(doubled, doubled, finder=GivenFaces(2 * points, 2 * points)))[0]
    assert np.abs(large.expr - small.expr).max() < 0.02 * np.abs(small.expr).max()


# Networks of the user


@pytest.mark.parametrize(
    ("outputs", "size", "field"),
    [({"id": 512}, 100, "input"), ({"id": 7}, 112, "id"), ({}, 112, "network")],
    ids=["size", "length", "nothing"],
)
def test_a_network_that_does_not_fit_is_refused(tmp_path, outputs, size, field):
    path = tmp_path / "face.onnx"
    if outputs:
        write_network(path, outputs, size=size)
    else:
        path.write_bytes(b"not a network")
    points = points_at(csim.PLACES)
    image = soft_noise(112)
    with pytest.raises(DataError, match=field):
        IdentitySimilarity(path).measure(Pair(image, image, finder=GivenFaces(points, points)))


def test_weights_beside_a_network_are_read_and_others_are_not(tmp_path):
    """As torch.onnx exports networks with much in them: `face.onnx` and `face.bin`."""
    import onnx

    folder = tmp_path / "user"
    folder.mkdir()
    path = write_network(folder / "face.onnx", {"id": 512}, size=112)
    points, image = points_at(csim.PLACES), soft_noise(112)
    pairs = [Pair(image, 1 - image, finder=GivenFaces(points, points)) for _ in range(2)]
    whole = IdentitySimilarity(path).measure(pairs[0])
    beside = {"save_as_external_data": True, "location": "face.bin", "size_threshold": 0}
    onnx.save(onnx.load(path), path, **beside)
    assert IdentitySimilarity(path).measure(pairs[1]) == pytest.approx(whole, abs=1e-6)

    (folder / "face.bin").rename(tmp_path / "face.bin")
    model = onnx.load(path, load_external_data=False)
    for entry in model.graph.initializer[0].external_data:
        if entry.key == "location":
            entry.value = "../face.bin"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(DataError, match="network: expected ONNX that loads"):
        IdentitySimilarity(path)


def test_a_regressor_with_other_outputs_is_refused(tmp_path):
    path = write_network(tmp_path / "flame.onnx", {"shape": 100, "light": 27}, size=224)
    with pytest.raises(DataError, match=r"236 numbers, or expression and pose, found shape, light"):
        FlameRegressor(path)


def test_a_network_that_overflows_is_refused(tmp_path):
    path = write_network(tmp_path / "face.onnx", {"id": 512}, size=112, scale=3e38)
    points, image = points_at(csim.PLACES), np.ones((112, 112, 3), np.float32)
    with pytest.raises(DataError, match="finite"):
        IdentitySimilarity(path).measure(Pair(image, image, finder=GivenFaces(points, points)))


def test_weights_that_are_not_there_are_said_at_once(tmp_path):
    gone = tmp_path / "gone.onnx"
    pytest.importorskip("mediapipe", reason="needs mediapipe")
    for find, weights in ((csim.find, Weights(arcface=gone)), (flame.find, Weights(flame=gone))):
        with pytest.raises(ArgumentError, match=r"gone\.onnx: cannot be read"):
            find(weights)


# LPIPS


def test_lpips_of_the_users_weights(tmp_path):
    pytest.importorskip("torch", reason="needs the extra [fit]")
    from tiny_vgg import write_tiny_vgg

    from cap4d.perceptual.lpips import load_lpips

    metric = lpips.LpipsMetric(load_lpips(write_tiny_vgg(tmp_path), width=4))
    image = soft_noise()
    values = [metric.measure(Pair(blurred(image, sigma), image)) for sigma in (0, 1, 2, 4)]
    assert values[0] == 0
    assert values == sorted(values)
    assert metric.measure(Pair(image, image)) == 0


def test_lpips_without_weights_says_what_it_needs(tmp_path, monkeypatch):
    pytest.importorskip("torch", reason="needs the extra [fit]")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert "download.pytorch.org" in lpips.find(Weights()).needs
    with pytest.raises(ArgumentError, match="lpips weights"):
        lpips.find(Weights(lpips=tmp_path))


# JOD


@pytest.fixture
def fvvdp():
    for module in ("torch", "pyfvvdp", "ffmpeg", "past", "imageio"):
        pytest.importorskip(
            module,
            reason="needs FovVideoVDP, for non-commercial use only and so never installed by itself: "
            "pip install 'cap4d[jod]', then pip install --no-deps pyfvvdp",
        )


def test_jod_falls_with_harm_and_a_video_is_taken_in_order(fvvdp):
    metric, image = JustObjectionableDifference(), soft_noise(96)
    values = [metric.measure(Pair(blurred(image, sigma), image)) for sigma in (0, 1, 2)]
    assert values[0] == 10
    assert values == sorted(values, reverse=True)
    taken = []

    def pairs():
        for i in range(4):
            taken.append(i)
            yield Pair(shifted(image, i), shifted(image, i))

    assert metric.measure_video(pairs(), count=4, fps=30) == pytest.approx(10)
    assert taken == [0, 1, 2, 3]


def test_jod_is_what_fovvideovdp_says_of_whole_arrays(fvvdp):
    metric = JustObjectionableDifference()
    truth = np.stack([shifted(soft_noise(64), i) for i in range(4)])
    film = np.clip(truth + 0.05, 0, 1)
    whole = metric._predictor.predict(film, truth, dim_order="FHWC", frames_per_second=25)[0]
    pairs = (Pair(image, right) for image, right in zip(film, truth, strict=True))
    assert metric.measure_video(pairs, count=4, fps=25) == pytest.approx(float(whole), abs=1e-4)
    still = metric._predictor.predict(film[0], truth[0], dim_order="HWC")[0]
    assert metric.measure(Pair(film[0], truth[0])) == pytest.approx(float(still), abs=1e-4)


# All of them


def test_every_metric_is_there_or_says_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    found = metrics_available(Weights())
    assert tuple(metric.name for metric in found) == METRIC_NAMES
    absent = {metric.name: metric.needs for metric in found if not hasattr(metric, "measure")}
    assert {"LPIPS", "CSIM", "AED", "APD", "AED-mp", "APD-mp"} <= set(absent)
    assert all(len(needs) > 20 for needs in absent.values())
    for metric in found:
        if metric.name not in absent:
            assert metric.better in ("higher", "lower")
            assert len(type(metric).__doc__) > 80  # its definition, which reports quote


def test_tables_know_of_which_metrics_more_is_better():
    kinds = [Psnr, PersonPsnr, Ssim, IdentitySimilarity, lpips.LpipsMetric, JustObjectionableDifference]
    kinds += [FanDistance, ExpressionDistance, PoseDistance, TrackedExpressionDistance, TrackedPoseDistance]
    kinds += [KeypointDistance, GazeError, BlinkError]
    assert {kind.name for kind in kinds} == set(METRIC_NAMES)
    assert {kind.name for kind in kinds if kind.better == "higher"} == HIGHER


def test_metrics_are_chosen_by_name():
    assert [m.name for m in metrics_available(Weights(), only=["SSIM", "PSNR"])] == ["PSNR", "SSIM"]
    with pytest.raises(ArgumentError, match="got VMAF"):
        metrics_available(Weights(), only=["PSNR", "VMAF"])
    with pytest.raises(ArgumentError, match="got none"):
        metrics_available(Weights(), only=[])


def test_without_mediapipe_landmark_metrics_say_so(monkeypatch):
    monkeypatch.setattr("cap4d.evaluate.metrics.registry.mediapipe_missing", lambda: "MediaPipe (pip ...)")
    absent = metrics_available(Weights(), only=["AKD", "gaze", "blink", "AED-mp", "APD-mp"])
    assert all(metric.needs == "MediaPipe (pip ...)" for metric in absent)
