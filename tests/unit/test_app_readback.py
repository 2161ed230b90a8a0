"""Pictures come out of framebuffers whole, in order, one call later."""

from __future__ import annotations

import numpy as np
import pytest
from cap4d.app.gl_context import GlUnavailableError, headless_context
from cap4d.app.readback import Readback


@pytest.fixture(scope="module")
def ctx():
    try:
        context = headless_context()
    except GlUnavailableError as error:
        pytest.skip(str(error))
    yield context
    context.gc()
    context.release()


def framebuffer(ctx, image: np.ndarray):
    return ctx.framebuffer(ctx.texture(image.shape[1::-1], 4, image.tobytes()))


def test_pictures_come_a_call_later_and_upright(ctx) -> None:
    rng, readback, found = np.random.default_rng(0), Readback(ctx), []
    images = [rng.integers(256, size=(h, w, 4), dtype=np.uint8) for h, w in [(5, 7)] * 3 + [(1, 1), (33, 9)]]
    for k, image in enumerate(images):
        found.append(readback.push(framebuffer(ctx, image), image.shape[1::-1], 0.5 * k))
    found.append(readback.flush())
    assert found[0] is None and readback.flush() is None
    for k, (image, shown) in enumerate(zip(images, found[1:], strict=True)):
        assert shown.t == 0.5 * k and np.array_equal(shown.image, image[::-1])


def test_row_0_may_be_the_top_already(ctx) -> None:
    image = np.random.default_rng(1).integers(256, size=(4, 3, 4), dtype=np.uint8)
    readback = Readback(ctx, upright=False)
    readback.push(framebuffer(ctx, image), (3, 4), 0.0)
    assert np.array_equal(readback.flush().image, image)
