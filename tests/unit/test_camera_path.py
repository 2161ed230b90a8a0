"""Cameras of a file are real cameras: rigid motions and positive focal lengths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cap4d.errors import DataError
from cap4d.player.camera_path import file_path

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
