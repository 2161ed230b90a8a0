"""The prepared splatter at the edge, against the reference: hard clouds, hard triangles, and no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hard_meshes import FLAT, MESHES, Mesh, flat_among_others, slivers
from hard_splats import SCENES, frontal, scene_around
from hypothesis import given, settings
from hypothesis import strategies as st
from parity import tolerances as tol
from parity.test_splatting import BACKGROUND, FIELDS, near_flip
from splat_scenes import cloud, view

from cap4d import _core
from cap4d.bind import bind, triangle_frames
from cap4d.camera import Camera
from cap4d.gaussians import Gaussians
from cap4d.raster import rasterize

POISON = np.float32(
    [0, -0.0, 1e-45, -1e-40, 1e-38, 1e-6, -1e4, 65520, 1e19, 1e30, -3.4e38, np.nan, np.inf, -np.inf]
)


def splatter(clouds: Gaussians, *triangles: np.ndarray) -> _core.Splatter:
    return _core.Splatter(*(np.ascontiguousarray(getattr(clouds, n)) for n in FIELDS), *triangles)


def halved(clouds: Gaussians) -> Gaussians:
    """With the colours that a splatter keeps."""
    return replace(clouds, sh=clouds.sh.clip(-65504, 65504).astype(np.float16).astype(np.float32))


def pictures(
    made: _core.Splatter, camera: Camera, vertices: np.ndarray | None = None
) -> tuple[list[np.ndarray], np.ndarray]:
    """rgb, alpha and depth, and the bytes: finite, the same for one and two threads and the second time."""
    where = (camera.viewmat, camera.K, camera.width, camera.height, BACKGROUND, vertices)
    one, two, again = (made.render(*where, threads) for threads in (1, 2, 2))
    assert all(np.isfinite(x).all() for x in one)
    assert all(np.array_equal(a, b) and np.array_equal(a, c) for a, b, c in zip(one, two, again, strict=True))
    out = np.empty((camera.height, camera.width, 4), np.uint8)
    made.draw(out, camera.viewmat, camera.K, BACKGROUND, vertices)
    assert np.abs(out[..., :3] - 255.0 * one[0].clip(0, 1)).max() <= 0.52
    return list(one), out


def check_against_reference(found: list[np.ndarray], clouds: Gaussians, camera: Camera, bound: float) -> None:
    """`clouds` may hold float64, which `Gaussians` would refuse: any object with its fields."""
    inputs = [torch.from_numpy(np.asarray(getattr(clouds, n), np.float64)) for n in FIELDS]
    slow = rasterize(*inputs, camera=camera, background=BACKGROUND, backend="reference")
    want = [getattr(slow, o).numpy() for o in ("rgb", "alpha", "depth")]
    error = [np.abs(a - b) / max(1, np.abs(b).max()) for a, b in zip(found, want, strict=True)]
    error = np.maximum(error[0].max(-1), np.maximum(*error[1:]))
    flips = near_flip(clouds, camera)
    print(f"{_core.isa()}: {error[~flips].max():.1e}, {flips.mean():.1e} near a flip")
    assert flips.mean() <= tol.HARD_FLIP_SHARE
    assert error[~flips].max() <= bound
    assert error.max() <= bound + 2 * tol.FLIP_SIZE


@pytest.mark.parametrize("name", SCENES)
def test_pictures_agree(name: str) -> None:
    clouds, camera = SCENES[name]()
    found, _ = pictures(splatter(clouds), camera)
    check_against_reference(found, halved(clouds), camera, tol.HARD[name][0])


@pytest.mark.parametrize("value", POISON, ids=str)
@pytest.mark.parametrize("field", FIELDS)
def test_no_number_spreads(field: str, value: np.float32) -> None:
    victim = 7
    for clouds, camera in (scene_around(victim), (cloud(20, seed=50), view(33, 29, yaw_deg=45.0))):
        others = Gaussians(*(np.delete(getattr(clouds, n), victim, 0) for n in FIELDS))
        without, bytes_without = pictures(splatter(others), camera)
        for part in (*range(min(getattr(clouds, field)[victim].size, 12)), slice(None)):
            arrays = {n: getattr(clouds, n).copy() for n in FIELDS}
            arrays[field].reshape(20, -1)[victim, part] = value
            found, drawn = pictures(splatter(Gaussians(**arrays)), camera)
            if not np.isfinite(value):
                assert all(np.array_equal(a, b) for a, b in zip(found, without, strict=True))
                assert np.array_equal(drawn, bytes_without)


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    poisons=st.lists(
        st.tuples(st.sampled_from(FIELDS), st.integers(0, 48), st.sampled_from(POISON.tolist())),
        min_size=1,
        max_size=4,
    ),
)
def test_no_numbers_together_spread(seed: int, poisons: list[tuple[str, int, float]]) -> None:
    clouds, camera = cloud(12, seed=seed), view(33, 29, yaw_deg=45.0)
    arrays = {n: getattr(clouds, n).copy() for n in FIELDS}
    for field, part, value in poisons:
        row = arrays[field].reshape(12, -1)[5]
        row[slice(None) if part == 48 else part % len(row)] = value
    found, _ = pictures(splatter(Gaussians(**arrays)), camera)
    if not all(np.isfinite(arrays[n][5]).all() for n in FIELDS):
        others = Gaussians(*(np.delete(getattr(clouds, n), 5, 0) for n in FIELDS))
        assert all(
            np.array_equal(a, b) for a, b in zip(found, pictures(splatter(others), camera)[0], strict=True)
        )


class Posed:
    """float64 Gaussians: `Gaussians` holds float32 only."""

    def __init__(self, *fields: np.ndarray) -> None:
        self.means, self.quats, self.scales, self.opacities, self.sh = fields


def riders(faces: int) -> tuple[Gaussians, np.ndarray]:
    """Four Gaussians on each triangle, in its frame: within it, of a third of its size. They share a colour:
    on a triangle that is a point they have one depth, and float64 tells an order where float32 sees none.
    """
    clouds = halved(cloud(4 * faces, seed=60, size=0.3, spread=0.3, degree=1))
    binding = np.repeat(np.arange(faces, dtype=np.int32), 4)
    return replace(clouds, sh=clouds.sh[binding]), binding


def check_bound(mesh: Mesh, *, shift: float = 0.0) -> None:
    vertices, faces = mesh
    clouds, binding = riders(len(faces))
    camera = view(48, 48, fov_y_deg=40.0)
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] -= viewmat[:3, :3] @ np.full(3, shift)
    camera = replace(camera, viewmat=viewmat)
    found, _ = pictures(splatter(clouds, binding, faces), camera, vertices)
    local = {
        "means": clouds.means,
        "quats": clouds.quats,
        "log_scales": np.log(clouds.scales.astype(np.float64)),
    }
    local = {k: v.astype(np.float64) for k, v in local.items()}
    means, quats, scales = bind(triangle_frames(vertices.astype(np.float64), faces), **local, binding=binding)
    posed = Posed(means, quats, scales, clouds.opacities, clouds.sh)
    assert found[1].max() > 0.05
    if shift == 0:
        check_against_reference(found, posed, camera, tol.HARD_BOUND)
        return
    inputs = [torch.from_numpy(np.asarray(getattr(posed, n), np.float64)) for n in FIELDS]
    slow = rasterize(*inputs, camera=camera, background=BACKGROUND, backend="reference")
    error = np.abs(found[0] - slow.rgb.numpy()).max()
    print(f"{_core.isa()}: {error:.1e} at {shift:g} m")
    assert error <= tol.HARD_BOUND_FAR


@pytest.mark.parametrize("name", ["good", "sliver_1e-4", "sliver_1e-6", "eyelid", "inverted"])
def test_riders_of_slivers_agree(name: str) -> None:
    check_bound(MESHES[name]())


def test_riders_far_away_agree() -> None:
    check_bound(slivers(8e-3, shift=1e4), shift=1e4)


@pytest.mark.parametrize("name", [name for name in FLAT if name != "long"])
def test_riders_of_flat_triangles_agree(name: str) -> None:
    check_bound(flat_among_others(name))


@settings(max_examples=200, deadline=None)
@given(vertex=st.integers(0, 17), part=st.integers(0, 3), value=st.sampled_from(POISON.tolist()))
def test_a_bad_vertex_takes_its_triangle_at_most(vertex: int, part: int, value: float) -> None:
    vertices, faces = slivers(5e-3, count=6)
    clouds, binding = riders(6)
    camera = frontal(40, 40, focal=60.0)
    vertices = vertices + np.float32([0, 0, 0.5])
    bad = vertices.copy()
    bad[vertex, part if part < 3 else slice(None)] = value
    found, _ = pictures(splatter(clouds, binding, faces), camera, bad)
    order = splatter(clouds, binding, faces).order(camera.viewmat, bad)
    assert sorted(order) == list(range(24))
    if not np.isfinite(value):
        rest = binding != vertex // 3
        others = splatter(Gaussians(*(getattr(clouds, n)[rest] for n in FIELDS)), binding[rest], faces)
        assert all(
            np.array_equal(a, b) for a, b in zip(found, pictures(others, camera, vertices)[0], strict=True)
        )


def test_no_gaussians_are_the_background() -> None:
    clouds = Gaussians(*(getattr(cloud(2), n)[:0] for n in FIELDS))
    found, drawn = pictures(splatter(clouds), frontal(5, 4))
    assert (found[0] == np.float32(BACKGROUND)).all() and not found[1].any() and (drawn[..., 3] == 255).all()


def test_an_image_of_8192_px_in_bytes() -> None:
    """Its pixels are those of the picture in floats, which the strips above compare with the reference."""
    clouds, camera = cloud(30, seed=61, degree=0), view(8192, 256)
    (rgb, alpha, _), out = pictures(splatter(clouds), camera)
    assert alpha.max() > 0.5 and np.ptp(out[..., :3]) > 100 and rgb.shape == (256, 8192, 3)
