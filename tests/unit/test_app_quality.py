"""As many pixels as keep up."""

import pytest
from cap4d.app.quality import SMALLEST, WINDOW, Quality


def feed(quality, seconds, pictures=WINDOW):
    for _ in range(pictures):
        quality.picture_took(seconds, 1 / 30)
    return quality.scale


def test_slow_pictures_get_smaller_and_quick_ones_grow_back():
    quality = Quality()
    assert quality.scale == 1
    assert feed(quality, 0.1) < 1
    assert feed(quality, 0.1, 100 * WINDOW) == SMALLEST
    assert feed(quality, 0.001) > SMALLEST
    assert feed(quality, 0.001, 100 * WINDOW) == 1


def test_what_just_fits_stays():
    quality = Quality()
    assert feed(quality, 0.75 / 30, 20 * WINDOW) == 1


def test_one_picture_that_was_held_up_changes_nothing():
    quality = Quality()
    feed(quality, 0.02, WINDOW - 1)
    assert feed(quality, 10.0, 1) == 1


def test_the_user_can_fix_it():
    quality = Quality()
    quality.choose(0.5)
    assert feed(quality, 1.0, 10 * WINDOW) == 0.5
    quality.choose(None)
    assert quality.scale == pytest.approx(1)
