"""Screenshots: straight alpha, free names, whole files."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from cap4d.app.screenshot import free_path, save_screenshot, straight

from cap4d.errors import ArgumentError


def read(path: Path) -> np.ndarray:
    with av.open(str(path)) as file:
        return next(file.decode(video=0)).to_ndarray(format="rgba")


def test_names_are_free_and_alpha_stays(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(256, size=(5, 7, 4), dtype=np.uint8)
    first, second = (save_screenshot(tmp_path, image, name="me") for _ in range(2))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["me_0001.png", "me_0002.png"]
    assert np.array_equal(read(first), image) and np.array_equal(read(second), image)


def test_a_gap_in_the_numbers_is_filled(tmp_path: Path) -> None:
    for number in (1, 2, 4):
        (tmp_path / f"a_{number:04d}.mp4").touch()
    assert free_path(tmp_path, "a", ".mp4").name == "a_0003.mp4"
    assert free_path(tmp_path, "a", ".png").name == "a_0001.png"


def test_no_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="does not exist"):
        save_screenshot(tmp_path / "none", np.zeros((2, 2, 3), np.uint8))
    (tmp_path / "file").touch()
    with pytest.raises(ArgumentError, match="does not exist"):
        save_screenshot(tmp_path / "file", np.zeros((2, 2, 3), np.uint8))


def test_colour_is_divided_by_alpha() -> None:
    premultiplied = np.float32([[[0.25, 0.1, 0, 0.5], [0, 0, 0, 0], [1, 0.5, 0, 1], [2, 0, 0, 1.5]]])
    assert straight(premultiplied).tolist() == [
        [[128, 51, 0, 128], [0, 0, 0, 0], [255, 128, 0, 255], [255, 0, 0, 255]]
    ]
    assert straight(np.uint8([[[100, 50, 0, 200]]])).tolist() == [[[128, 64, 0, 200]]]
