"""The bench's own renderer is the reference's equal, and its counts are those of a look at every pair."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from splat_scenes import SCENES, cloud, view

from cap4d.evaluate.bench.tiled import render_tiled
from cap4d.evaluate.bench.work import count_work
from cap4d.raster import rasterize
from cap4d.raster.reference import eval_sh, pixel_alphas, project


def fields(gaussians) -> list[torch.Tensor]:
    names = ("means", "quats", "scales", "opacities", "sh")
    return [torch.from_numpy(getattr(gaussians, name)) for name in names]


@pytest.mark.parametrize("name", SCENES)
def test_draws_what_the_reference_draws(name: str) -> None:
    gaussians, camera = SCENES[name]()
    expected = rasterize(*fields(gaussians), camera=camera, backend="reference")
    found = render_tiled(gaussians, camera)
    for key in ("rgb", "alpha", "depth"):
        assert np.abs(getattr(found, key) - getattr(expected, key).numpy()).max() < 1e-9, key


def test_a_background_shows_where_nothing_covers_it() -> None:
    gaussians, camera = SCENES["mixed"]()
    colour = (0.2, 0.5, 0.9)
    expected = rasterize(*fields(gaussians), camera=camera, background=colour, backend="reference")
    assert np.abs(render_tiled(gaussians, camera).over(colour) - expected.rgb.numpy()).max() < 1e-9


def test_float32_stays_float32_and_near() -> None:
    gaussians, camera = SCENES["mixed"]()
    picture = render_tiled(gaussians, camera, dtype=np.float32)
    assert picture.rgb.dtype == np.float32
    assert np.abs(picture.rgb - render_tiled(gaussians, camera).rgb).max() < 1e-3


def test_bad_numbers_are_not_drawn() -> None:
    gaussians, camera = SCENES["mixed"]()
    clean = render_tiled(gaussians, camera).rgb
    before = gaussians.opacities[0]
    gaussians.opacities[0] = 0
    without = render_tiled(gaussians, camera).rgb
    gaussians.opacities[0], gaussians.means[0, 1] = before, np.nan
    assert np.array_equal(render_tiled(gaussians, camera).rgb, without)
    assert not np.array_equal(clean, without)


def test_counts_are_those_of_every_pair_looked_at() -> None:
    gaussians, camera = cloud(150, seed=4), view(67, 41)
    means, quats, scales, opacities, sh = (x.double() for x in fields(gaussians))
    projected = project(means, quats, scales, opacities, camera=camera)
    assert (eval_sh(sh, means - means.new_tensor(camera.position), 3).abs() < 1e6).all()
    y, x = np.indices((camera.height, camera.width)).reshape(2, -1)
    pixels = torch.from_numpy(np.stack([x, y], 1) + 0.5)
    alphas = pixel_alphas(projected.means2d, projected.conics, opacities[projected.ids], pixels).numpy()
    through = np.cumprod(1 - alphas, 1)
    lit = alphas > 0
    shown = lit & (through >= 1e-4)

    def groups(hits: np.ndarray, columns: int, rows: int) -> int:
        """Blocks of pixels with at least one hit, over all Gaussians."""
        block = y // rows * 1000 + x // columns
        return sum(len(np.unique(block[hit])) for hit in hits.T)

    work, picture = count_work(gaussians, camera)
    assert (work.gaussians, work.drawn) == (150, len(projected.ids))
    assert (work.inside, work.blended) == (lit.sum(), shown.sum())
    assert work.pairs == groups(lit, 16, 16)
    assert work.lanes == {
        4: 4 * groups(shown, 4, 1),
        8: 8 * groups(shown, 4, 2),
        16: 16 * groups(shown, 4, 4),
    }
    assert (work.pixels, work.sh_count) == (67 * 41, 16)
    assert np.abs(picture.rgb - render_tiled(gaussians, camera).rgb).max() < 1e-12


def test_nothing_to_draw_is_no_work() -> None:
    gaussians, camera = cloud(3), view()
    gaussians.opacities[:] = 0
    work, picture = count_work(gaussians, camera)
    assert (work.drawn, work.pairs, work.inside, work.blended) == (0, 0, 0, 0)
    assert not picture.rgb.any() and not picture.alpha.any() and not picture.depth.any()
