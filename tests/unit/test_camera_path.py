"""Cameras of a file are real cameras: rigid motions and positive focal lengths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.errors import DataError
from cap4d.player.camera_path import file_path, live_camera_path, with_live_head

SOUND = np.tile(np.eye(4), (2, 1, 1))
ONES = np.ones((2, 1))


def cameras(path: Path, **changes: np.ndarray) -> Path:
    arrays = dict(extr=SOUND, fx=500 * ONES, fy=500 * ONES, cx=ONES, cy=ONES, resolution=np.array([48, 64]))
    np.savez(path, **{**arrays, **changes})
    return path


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        (dict(extr=np.zeros((2, 4, 4))), r"extr\[0\]"),
        (dict(extr=np.full((2, 4, 4), 1e300)), r"extr\[0\]"),
        (dict(extr=np.stack([np.eye(4), np.diag([-1.0, 1, 1, 1])])), r"extr\[1\]"),
        (dict(fx=0 * ONES), "fx, fy"),
        (dict(fy=np.array([[500.0], [-1]])), "fx, fy"),
    ],
)
def test_what_is_no_camera_is_refused(changes: dict, field: str, tmp_path: Path) -> None:
    assert file_path(cameras(tmp_path / "sound.npz"), None)
    with pytest.raises(DataError, match=f": {field}: expected"):
        file_path(cameras(tmp_path / "c.npz", **changes), None)


def test_other_arrays_are_not_read(tmp_path: Path) -> None:
    assert file_path(cameras(tmp_path / "c.npz", notes=np.array([{}], object)), None)


ZERO = np.zeros(3, np.float32)
FRONT = Camera(np.diag([500.0, 500.0, 1.0]), np.array(np.eye(4)), 64, 48)


def moment(rot: list[float] | None, tra: list[float] | None = None) -> Frame:
    pose = (None if x is None else np.float32(x) for x in (rot, tra))
    return Frame(0.0, "rig", ZERO, ZERO, ZERO, ZERO, *pose)


def test_a_live_head_that_turns_left_is_seen_from_its_right() -> None:
    turned = with_live_head(FRONT, moment([0, 0.5, 0], [0, 0, 0]))
    # The head's own nose (OpenCV axes: towards -z) then points to the picture's right.
    nose, centre = ((turned.viewmat @ [0, 0, z, 1])[:3] for z in (-0.1, 0.0))
    assert np.allclose(nose - centre, [0.1 * np.sin(0.5), 0, -0.1 * np.cos(0.5)], atol=1e-6)
    assert with_live_head(FRONT, moment(None)) is FRONT


def test_a_live_head_far_away_stays_in_the_picture() -> None:
    near, far = ([0.01, 0, 0], [0, 0, 0.7])
    still = with_live_head(FRONT, moment([0, 0.5, 0], [0, 0, 0])).viewmat
    assert np.allclose(with_live_head(FRONT, moment([0, 0.5, 0], far)).viewmat, still)
    assert not np.allclose(with_live_head(FRONT, moment([0, 0.5, 0], near)).viewmat, still, atol=1e-3)


def test_cameras_of_a_file_fold_a_live_head_in_once(tmp_path: Path) -> None:
    file, settings = str(cameras(tmp_path / "c.npz")), dict(fps=30, size=None)
    frame = moment([0, 0.5, 0], [0, 0, 0])
    expected = file_path(Path(file), None)(0, frame).viewmat
    assert np.array_equal(live_camera_path(file, FRONT, ZERO, **settings)(0, frame).viewmat, expected)
    standing = live_camera_path("static", FRONT, ZERO, **settings)(0, frame)
    assert np.array_equal(standing.viewmat, with_live_head(FRONT, frame).viewmat)
