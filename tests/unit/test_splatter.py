"""The prepared splatter draws what the stateless renderer draws, up to its half-precision colours."""

from __future__ import annotations

import numpy as np
import pytest
from splat_scenes import SCENES, cloud, view

from cap4d import _core
from cap4d.bind import bind_fast
from cap4d.gaussians import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh")
HALF = 3e-3  # of colours up to about 2.5 whose 16 coefficients are rounded to 11 bits


def arrays(gaussians: Gaussians) -> list[np.ndarray]:
    return [np.ascontiguousarray(getattr(gaussians, name)) for name in FIELDS]


def mesh(faces: int, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Triangles around the origin, some without area, some slivers, one a point."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(0, 0.06, (faces, 3, 3)) * [1, 1, 0.5]
    vertices[::5, 2] = vertices[::5, 0]
    vertices[1::5, 2] = vertices[1::5, 0] + 0.3 * (vertices[1::5, 1] - vertices[1::5, 0])
    vertices[3] = vertices[3, :1]
    indices = np.arange(3 * faces, dtype=np.int32).reshape(-1, 3)
    return vertices.reshape(-1, 3).astype(np.float32), indices


def test_parts_of_a_word_are_told_apart() -> None:
    """Sizes that fill no block of 16, on pictures that no tile divides."""
    for count in (1, 15, 16, 17, 1025):
        gaussians, camera = cloud(count, seed=count), view(67, 35)
        where = (camera.viewmat, camera.K, camera.width, camera.height, (0.1, 0.2, 0.3))
        found = _core.Splatter(*arrays(gaussians)).render(*where)
        expected = _core.render(*arrays(gaussians), *where)
        assert np.abs(found[0] - expected[0]).max() < HALF
        np.testing.assert_allclose(found[1], expected[1], atol=1e-5)


@pytest.mark.parametrize("name", SCENES)
def test_draws_what_render_draws(name: str) -> None:
    gaussians, camera = SCENES[name]()
    where = (camera.viewmat, camera.K, camera.width, camera.height, (1.0, 0.5, 0.2))
    splatter = _core.Splatter(*arrays(gaussians))
    found, expected = splatter.render(*where), _core.render(*arrays(gaussians), *where)
    for a, b, bound in zip(found, expected, (HALF, 1e-4, 1e-4), strict=True):
        flips = np.abs(a - b) > bound  # a contribution at 1/255 that one of them leaves out
        flips = flips.any(-1) if flips.ndim == 3 else flips
        assert flips.mean() <= 2e-3
    again = splatter.render(*where, threads=1)
    assert all(np.array_equal(a, b) for a, b in zip(found, again, strict=True)), "threads show"


@pytest.mark.parametrize("background", [None, (1.0, 0.5, 0.2)])
def test_bytes_are_the_rounded_picture(background: tuple[float, ...] | None) -> None:
    gaussians, camera = cloud(), view(61, 45)
    splatter = _core.Splatter(*arrays(gaussians))
    out = np.full((45, 61, 4), 7, np.uint8)
    splatter.draw(out, camera.viewmat, camera.K, background)
    rgb, alpha, _ = splatter.render(camera.viewmat, camera.K, 61, 45, background)
    if background is None:
        rgb = rgb / np.maximum(alpha, 1e-6)[..., None]
    opacity = alpha if background is None else np.ones_like(alpha)
    expected = np.concatenate([rgb, opacity[..., None]], -1).clip(0, 1) * 255
    seen = out[..., 3] > 2  # 1 - transmittance has fewer digits than alpha where nothing is seen
    assert np.abs(out[seen] - expected[seen]).max() <= 0.52


def test_premultiplied_bytes_are_the_rounded_picture() -> None:
    gaussians, camera = cloud(), view(61, 45)
    splatter, out = _core.Splatter(*arrays(gaussians)), np.full((45, 61, 4), 7, np.uint8)
    splatter.draw(out, camera.viewmat, camera.K, premultiplied=True)
    rgb, alpha, _ = splatter.render(camera.viewmat, camera.K, 61, 45)
    expected = np.concatenate([rgb, alpha[..., None]], -1).clip(0, 1) * 255
    assert np.abs(out - expected).max() <= 0.52
    with pytest.raises(ValueError, match="premultiplied: expected no background"):
        splatter.draw(out, camera.viewmat, camera.K, (1.0, 1.0, 1.0), premultiplied=True)


def test_counts_every_gaussian_at_every_pixel() -> None:
    """Against pictures of one Gaussian each: it is where its alpha is not zero, seen or hidden."""
    gaussians, camera = cloud(150, seed=3), view(61, 45)
    fields, where = arrays(gaussians), (camera.viewmat, camera.K, 61, 45)
    expected = np.zeros((45, 61), int)
    for i in range(len(fields[0])):
        expected += _core.render(*(np.ascontiguousarray(x[i : i + 1]) for x in fields), *where)[1] > 0
    splatter, picture = _core.Splatter(*fields), np.empty((45, 61, 4), np.uint8)
    splatter.draw(picture, *where[:2])
    found = np.full((45, 61), 999, np.uint16)
    splatter.count(found, threads=1)
    assert expected.max() > 20 and (found != expected).mean() < 2e-3
    again = np.empty_like(found)
    splatter.count(again)
    assert np.array_equal(found, again)


def test_counting_needs_a_picture_and_its_size() -> None:
    splatter, camera = _core.Splatter(*arrays(cloud())), view(61, 45)
    with pytest.raises(ValueError, match="count: expected a picture"):
        splatter.count(np.empty((45, 61), np.uint16))
    splatter.draw(np.empty((45, 61, 4), np.uint8), camera.viewmat, camera.K)
    with pytest.raises(ValueError, match="out"):
        splatter.count(np.empty((61, 45), np.uint16))


def test_rides_on_triangles_as_bind_does() -> None:
    vertices, faces = mesh(40)
    rng = np.random.default_rng(1)
    gaussians, binding = cloud(900, size=0.3, spread=0.5), rng.integers(0, 40, 900).astype(np.int32)
    camera = view(96, 80)
    splatter = _core.Splatter(*arrays(gaussians), np.sort(binding), faces)
    local = {"means": gaussians.means, "quats": gaussians.quats, "log_scales": np.log(gaussians.scales)}
    posed = bind_fast(vertices, faces, **local, binding=np.sort(binding))
    where = (camera.viewmat, camera.K, camera.width, camera.height, (1.0, 1.0, 1.0))
    expected = _core.render(*posed, gaussians.opacities, gaussians.sh, *where)
    found = splatter.render(*where, vertices)
    flips = np.abs(found[0] - expected[0]).max(-1) > HALF
    assert expected[1].max() > 0.5 and flips.mean() <= 2e-3
    order = splatter.order(camera.viewmat, vertices)
    depths = posed[0] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    assert sorted(order) == list(range(900)) and np.diff(depths[order]).min() > -1e-6


def test_what_is_not_finite_is_never_drawn() -> None:
    gaussians, camera = cloud(64), view()
    where = (camera.viewmat, camera.K, camera.width, camera.height)
    for field in range(5):
        for poison in (np.nan, np.inf, -np.inf):
            fields = [a.copy() for a in arrays(gaussians)]
            fields[field].reshape(64, -1)[11, 0] = poison
            without = [np.delete(a, 11, 0) for a in arrays(gaussians)]
            found, expected = (_core.Splatter(*f).render(*where) for f in (fields, without))
            assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_colours_beyond_half_precision_stay_finite() -> None:
    gaussians, camera = cloud(20), view()
    fields = arrays(gaussians)
    fields[4] = fields[4] * np.float32(1e9)
    out = np.empty((camera.height, camera.width, 4), np.uint8)
    splatter = _core.Splatter(*fields)
    splatter.draw(out, camera.viewmat, camera.K, (0.0, 0.0, 0.0))
    assert np.isfinite(splatter.render(camera.viewmat, camera.K, camera.width, camera.height)[0]).all()


def test_nothing_is_allocated_after_the_first_picture() -> None:
    gaussians, camera = cloud(3000), view(200, 160)
    splatter, out = _core.Splatter(*arrays(gaussians)), np.empty((160, 200, 4), np.uint8)
    splatter.draw(out, camera.viewmat, camera.K)
    held = splatter.bytes
    for _ in range(5):
        splatter.draw(out, camera.viewmat, camera.K)
    assert splatter.bytes == held


@pytest.mark.parametrize(
    "change, named",
    [
        ({"binding": np.zeros(20, np.int32)}, "binding, faces"),
        ({"binding": np.full(20, 1, np.int32), "faces": np.zeros((1, 3), np.int32)}, "binding"),
        ({"binding": np.zeros(20, np.int32), "faces": np.full((1, 3), -1, np.int32)}, "faces"),
        ({"opacities": np.zeros(3, np.float32)}, "opacities"),
    ],
)
def test_bad_arguments_are_named(change: dict, named: str) -> None:
    arguments = dict(zip(FIELDS, arrays(cloud(20)), strict=True)) | change
    with pytest.raises(ValueError, match=named):
        _core.Splatter(**arguments)


def test_vertices_must_be_all_that_faces_name() -> None:
    vertices, faces = mesh(4)
    splatter = _core.Splatter(*arrays(cloud(20)), np.zeros(20, np.int32), faces)
    camera, out = view(), np.empty((45, 61, 4), np.uint8)
    for wrong in (None, vertices[:-1], vertices[:, :2].copy()):
        with pytest.raises(ValueError, match="vertices"):
            splatter.draw(out, camera.viewmat, camera.K, None, wrong)
