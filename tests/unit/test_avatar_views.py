"""Which frames are held out, and how images are made smaller."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_avatar import tiny_rig, write_tiny_capture

from cap4d.avatar.views import check_rig, held_out_frames, load_views, shrink, split_views
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError, DataError


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "sheet"
    write_tiny_capture(path, size=16)
    return Capture.load(path)


def lasting(capture, frames):
    """The capture's parameters repeated or cut to another length."""
    fields = ("expr", "rot", "tra", "eye_rot", "neck_rot", "jaw_rot")
    return replace(
        capture, **{f: np.resize(getattr(capture, f), (frames, getattr(capture, f).shape[1])) for f in fields}
    )


def test_of_a_video_every_tenth_frame_and_the_last_tenth(capture):
    marks = held_out_frames(lasting(capture, 183))
    assert np.flatnonzero(marks[:165]).tolist() == list(range(9, 165, 10))
    assert marks[165:].all()
    assert marks.sum() == 16 + 18


@pytest.mark.parametrize(("frames", "held_out"), [(1, 0), (3, 0), (4, 1), (19, 1)])
def test_of_a_few_stills_the_last(capture, frames, held_out):
    marks = held_out_frames(lasting(capture, frames))
    assert marks.sum() == held_out
    assert marks[frames - held_out :].all()


def test_of_many_cameras_at_most_ten(capture):
    rig = {"a": capture.cameras["cam0"], "b": capture.cameras["cam0"]}
    marks = held_out_frames(replace(lasting(capture, 300), cameras=rig))
    assert np.flatnonzero(marks).tolist() == list(range(290, 300))


def test_a_capture_that_marks_them_itself_is_obeyed(capture):
    marks = np.zeros(24, bool)
    marks[3] = True
    split = split_views([replace(capture, held_out=marks)], load_views([capture], 16))
    assert [v.frame for v in split.held_out] == [3]
    assert not split.tail.any()
    with pytest.raises(ArgumentError, match="not held out"):
        split_views([replace(capture, held_out=np.ones(24, bool))], load_views([capture], 16))


def test_the_split_is_complete_and_disjoint(capture):
    split = split_views([capture], load_views([capture], 16))
    train, held_out = ({v.frame for v in views} for views in (split.train, split.held_out))
    assert held_out == {9, 19, 22, 23}
    assert train | held_out == set(range(24))
    assert not train & held_out
    assert split.tail.tolist() == [False, False, True, True]


def test_views_are_averaged_down_and_their_cameras_follow(capture):
    view = load_views([capture], 8)[0][4]
    image = capture.image(capture.views[4])
    by_hand = image.reshape(8, 2, 8, 2, 3).mean((1, 3))
    np.testing.assert_allclose(view.target.numpy(), by_hand, atol=6e-4)
    point = np.array([0.02, 0.03, 0.05])
    full = capture.head_camera(capture.views[4]).project(point)
    np.testing.assert_allclose(view.camera.project(point)[:2], full[:2] / 2)
    assert view.coverage is None


def test_shrinking_keeps_the_mean():
    image = np.random.default_rng(0).random((12, 20, 3)).astype(np.float32)
    small = shrink(image, 5, 3)
    assert small.shape == (3, 5, 3)
    torch.testing.assert_close(small.mean((0, 1)), torch.from_numpy(image).mean((0, 1)))


def test_parameters_of_another_rig_are_refused(capture):
    check_rig(capture, tiny_rig())
    with pytest.raises(DataError, match="rig_name: expected builtin, found tiny"):
        check_rig(capture, replace(tiny_rig(), name="builtin"))
    with pytest.raises(DataError, match="expr"):
        check_rig(replace(capture, expr=capture.expr[:, :1]), tiny_rig())
