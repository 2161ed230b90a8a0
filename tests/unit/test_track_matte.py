"""A coarse matte moves to the edge that the image shows."""

import numpy as np
import pytest

for module in ("OpenImageIO", "torch", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from cap4d.track.matte import guided_filter, refine_matte, smoothstep  # noqa: E402


def test_a_linear_function_of_the_colours_passes_unchanged():
    guide = np.random.default_rng(0).random((40, 50, 3), np.float32)
    values = guide @ np.float32([0.2, -0.5, 0.7]) + np.float32(0.3)
    np.testing.assert_allclose(guided_filter(guide, values, 3, 1e-8), values, atol=1e-3)


def test_flat_colour_leaves_the_mean():
    guide = np.full((30, 30, 3), 0.5, np.float32)
    values = np.random.default_rng(0).random((30, 30), np.float32)
    filtered = guided_filter(guide, values, 3, 1e-4)
    assert filtered.std() < 0.3 * values.std() and abs(filtered.mean() - values.mean()) < 0.02


@pytest.mark.parametrize("offset", [-3, 3])
def test_the_edge_follows_the_image(offset):
    image = np.full((200, 200, 3), 200, np.uint8)
    image[:, :100] = (40, 30, 30)
    coarse = np.tile(np.clip((100 + offset - np.arange(200)) / 8 + 0.5, 0, 1).astype(np.float32), (200, 1))
    truth = np.arange(200) < 100
    refined = refine_matte(image, coarse)
    assert np.abs(refined - truth).mean() < 0.75 * np.abs(coarse - truth).mean()
    assert (refined[:, :80] == 1).all() and (refined[:, 120:] == 0).all()


def test_smoothstep_ends():
    np.testing.assert_allclose(smoothstep(np.array([0, 0.2, 0.5, 0.8, 1]), 0.2, 0.8), [0, 0, 0.5, 1, 1])
