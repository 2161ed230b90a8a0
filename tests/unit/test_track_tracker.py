"""The whole road on frames whose truth is known, and what it refuses."""

import numpy as np
import pytest

from cap4d.camera import Camera, head_fixed, opencv_from_rig
from cap4d.errors import ArgumentError, DataError
from cap4d.mesh import shade

for module in ("OpenImageIO", "torch", "cv2", "mediapipe"):
    pytest.importorskip(module, reason="needs the extra [track] and mediapipe")

from cap4d.capture.capture import Capture  # noqa: E402
from cap4d.capture.image import write_image  # noqa: E402
from cap4d.track import track  # noqa: E402

SIZE, FOCAL = 400, 520.0
TURNS = np.array([[0.0, 0.0, 0.0], [0.05, 0.3, 0.0], [-0.08, -0.25, 0.05]])


@pytest.fixture(scope="module")
def tracked(builtin_rig, tmp_path_factory):
    """Three photos of the built-in head, the last with an open mouth, tracked with its own rig."""
    photos = tmp_path_factory.mktemp("photos")
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    for i, rot in enumerate(TURNS):
        expr = np.zeros(builtin_rig.n_expressions, np.float32)
        expr[builtin_rig.expression_names.index("jawOpen")] = 0.6 * (i == 2)
        camera = Camera(K, head_fixed(np.eye(4), rot, np.array([0, 0, -0.55])), SIZE, SIZE)
        vertices = opencv_from_rig(builtin_rig.subject().pose(expr).astype(float))
        rgba = shade(vertices, builtin_rig.faces, camera, colors=builtin_rig.colors)
        grey = 0.55 * np.ones(3)
        write_image(photos / f"{i}.png", rgba[..., :3] * rgba[..., 3:] + grey * (1 - rgba[..., 3:]))
    output = tmp_path_factory.mktemp("out") / "capture"
    return track(photos, builtin_rig, output), Capture.load(output)


def test_report_and_capture_agree(tracked, builtin_rig):
    report, capture = tracked
    assert (report.frames, report.tracked, len(capture), len(capture.views)) == (3, 3, 3, 3)
    assert report.median_error < 1.5 and capture.error == pytest.approx(report.median_error)
    assert capture.rig_name == builtin_rig.name
    assert (capture.path / "overlay.png").is_file()


def test_turns_are_recovered(tracked):
    _, capture = tracked
    assert np.degrees(np.abs((capture.rot - capture.rot[0]) - (TURNS - TURNS[0])).max()) < 6


def test_the_mouth_opens_as_far_as_it_did(tracked, builtin_rig):
    """Measured on the lips, since several expressions open them."""
    _, capture = tracked
    opening = builtin_rig.expression_basis[builtin_rig.expression_names.index("jawOpen"), :, 1]
    lips = builtin_rig.regions["lips"]
    middle = lips[np.abs(builtin_rig.template[lips, 0]) < 0.006]
    lower = middle[opening[middle] < 0.9 * opening[middle].min()]
    upper = middle[opening[middle] > 0.1 * opening[middle].min()]
    moved = builtin_rig.subject().pose(capture.expr) - builtin_rig.template
    gap = (moved[:, upper, 1].mean(1) - moved[:, lower, 1].mean(1)) / (-0.6 * opening[lower].mean())
    assert 0.5 < gap[2] < 1.4 and np.abs(gap[:2]).max() < 0.3


def test_mattes_cover_the_face_and_not_the_corner(tracked):
    _, capture = tracked
    matte = capture.matte(capture.views[0])
    assert matte[SIZE // 2, SIZE // 2] == 1 and matte[:20, :20].max() < 0.1


def test_a_taken_output_is_refused_before_any_work(tmp_path, builtin_rig):
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "mine.txt").write_text("precious")
    write_image(tmp_path / "a.png", np.zeros((8, 8, 3)))
    with pytest.raises(ArgumentError, match="exists"):
        track(tmp_path / "a.png", builtin_rig, tmp_path / "capture")
    assert (tmp_path / "capture" / "mine.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("source", "output", "words"),
    [
        ("no.mp4", "capture", "no such video"),
        ("a.png", "nowhere/capture", "the folder of nowhere/capture does not exist"),
        ("a.png", "a.png", "exists already"),
    ],
)
def test_what_cannot_work_is_refused_before_any_work(source, output, words, tmp_path, monkeypatch):
    def look(*_):
        raise AssertionError("began to work")

    write_image(tmp_path / "a.png", np.zeros((8, 8, 3)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cap4d.track.tracker._look", look)
    with pytest.raises(ArgumentError, match=words):
        track(source, None, output)
    assert [f.name for f in tmp_path.iterdir()] == ["a.png"]


def test_pictures_without_a_face_leave_nothing(tmp_path, builtin_rig):
    write_image(tmp_path / "a.png", np.full((96, 128, 3), 0.3))
    with pytest.raises(DataError, match="a face") as caught:
        track(tmp_path / "a.png", builtin_rig, tmp_path / "capture")
    assert "\n" not in str(caught.value)
    assert [f.name for f in tmp_path.iterdir()] == ["a.png"]
