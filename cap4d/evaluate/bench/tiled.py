"""Splatting in NumPy, tile by tile, in any precision: the oracle for large pictures, the counter of the work
that a picture needs, and (in float32) the peer that a NumPy user would write. Not fast.

The maths is that of cap4d.raster.reference; a test holds the two together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cap4d.camera import NEAR, Camera
from cap4d.gaussians import SH_COUNTS, Gaussians
from cap4d.harmonics import sh_basis
from cap4d.rotation import quat_to_rotmat

EPS2D = 0.3  # px^2; these constants are those of src/cpp/constants.h, where each has its provenance
JACOBIAN_MARGIN = 0.3
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
QUAT_MIN = 1e-12
DEPTH_MAX = 1e7  # m
COLOR_MAX = 1e6

TILE = 16  # px a side
AT_ONCE = 512  # Gaussians of a tile


@dataclass(frozen=True, eq=False)
class Splats:
    """V Gaussians that may be seen, near to far.

    Args:
        ids: int64[V] which of the N.
        means2d: [V, 2] px.
        conics: [V, 3] 1/px^2: a, b, c of the density exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2).
        edges: [V, 2] px, half the sides of the box around the outline, where alpha is 1/255.
        opacities: [V].
        values: [V, 5] red, green, blue, 1, depth in m.
    """

    ids: np.ndarray
    means2d: np.ndarray
    conics: np.ndarray
    edges: np.ndarray
    opacities: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class Tile:
    """The pixels [x0, x0 + width) x [y0, y0 + height) and the Gaussians whose boxes meet them, near to far.

    Args:
        members: int64[K] indices into Splats.
    """

    x0: int
    y0: int
    width: int
    height: int
    members: np.ndarray


@dataclass(frozen=True, eq=False)
class Picture:
    """rgb [H, W, 3] premultiplied, alpha [H, W], expected depth [H, W] m (0 where alpha is 0)."""

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray

    def over(self, background: tuple[float, float, float]) -> np.ndarray:
        """[H, W, 3] on a background."""
        return self.rgb + (1 - self.alpha)[..., None] * np.asarray(background, self.rgb.dtype)


def render_tiled(gaussians: Gaussians, camera: Camera, *, dtype: type = np.float64) -> Picture:
    """Splats all Gaussians.

    Args:
        dtype: Of all arithmetic and of the result.
    """
    splats = project(gaussians, camera, dtype=dtype)
    image = np.zeros((camera.height, camera.width, 5), dtype)
    for tile in tiles(splats, camera):
        rows, columns = (slice(a, a + n) for a, n in ((tile.y0, tile.height), (tile.x0, tile.width)))
        image[rows, columns] = composite(splats, tile).reshape(tile.height, tile.width, 5)
    alpha = image[..., 3]
    depth = np.where(alpha > 0, image[..., 4] / np.where(alpha > 0, alpha, 1), 0)
    return Picture(image[..., :3], alpha, depth)


def project(gaussians: Gaussians, camera: Camera, *, dtype: type = np.float64) -> Splats:
    """Projects with the EWA approximation (Zwicker et al. 2002, eq. 31) and culls what no pixel shows."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    means, quats, scales, opacities, sh = (np.asarray(x, dtype) for x in fields)
    rotation, translation = camera.viewmat[:3, :3].astype(dtype), camera.viewmat[:3, 3].astype(dtype)
    with np.errstate(all="ignore"):  # what is not finite is not drawn
        colors = eval_sh(sh, means - camera.position.astype(dtype))
        view = means @ rotation.T + translation
        drawable = np.isfinite(means).all(1) & np.isfinite(quats).all(1) & np.isfinite(scales).all(1)
        drawable &= (view[:, 2] >= NEAR) & (view[:, 2] <= DEPTH_MAX)
        drawable &= (opacities >= ALPHA_MIN) & (np.abs(colors) <= COLOR_MAX).all(1)
    ids = np.flatnonzero(drawable)
    means2d, covariance, det = footprints(view[ids], quats[ids], scales[ids], rotation, camera)
    xx, xy, yy = covariance.T
    with np.errstate(all="ignore"):
        conics = np.stack([yy, -xy, xx], 1) / det[:, None]
        edges = np.sqrt(2 * np.log(opacities[ids] / dtype(ALPHA_MIN))[:, None] * np.stack([xx, yy], 1))
        size = np.array([camera.width, camera.height])
        seen = ((means2d + edges > 0) & (means2d - edges < size)).all(1) & np.isfinite(conics).all(1)
    depths = view[ids, 2]
    order = np.flatnonzero(seen)
    order = order[np.argsort(depths[order], kind="stable")]
    ids = ids[order]
    shown = np.maximum(colors[ids], 0)
    values = np.concatenate([shown, np.ones_like(shown[:, :1]), depths[order, None]], 1)
    return Splats(ids, means2d[order], conics[order], edges[order], opacities[ids], values)


def footprints(
    view: np.ndarray, quats: np.ndarray, scales: np.ndarray, rotation: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [V, 2] px, covariances [V, 3] (xx, xy, yy) px^2 with the low-pass, determinants [V]."""
    dtype = view.dtype.type
    focal, centre = (
        np.array([camera.K[i, j] for i, j in at], dtype) for at in (((0, 0), (1, 1)), ((0, 2), (1, 2)))
    )
    size = np.array([camera.width, camera.height], dtype)
    ratio = view[:, :2] / view[:, 2:]
    margin = dtype(JACOBIAN_MARGIN) * size / (2 * focal)
    clamped = np.clip(ratio, -centre / focal - margin, (size - centre) / focal + margin)
    jacobian_view = (focal / view[:, 2:])[..., None] * (rotation[:2] - clamped[..., None] * rotation[2])
    has_direction = np.abs(quats).max(1, keepdims=True, initial=0) > QUAT_MIN
    unit = np.where(has_direction, quats, np.array([1, 0, 0, 0], dtype))
    root = jacobian_view @ (quat_to_rotmat(unit) * scales[:, None])
    low_pass = dtype(EPS2D)
    xx, yy = (np.square(root[:, i]).sum(-1) + low_pass for i in (0, 1))
    xy = (root[:, 0] * root[:, 1]).sum(-1)
    det = np.square(np.cross(root[:, 0], root[:, 1])).sum(-1) + low_pass * (xx + yy) - low_pass**2
    return focal * ratio + centre, np.stack([xx, xy, yy], 1), det


def eval_sh(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours [V, 3] = 0.5 + SH `sh` [V, S, 3] along `directions` [V, 3], before the clamp at 0."""
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), SH_COUNTS[sh.shape[1]])
    return np.einsum("vs,vsc->vc", basis, sh) + sh.dtype.type(0.5)


def tiles(splats: Splats, camera: Camera) -> Iterator[Tile]:
    """The tiles that the outlines' boxes meet, row by row."""
    size = np.array([camera.width, camera.height])
    first = np.clip(np.floor((splats.means2d - splats.edges) / TILE), 0, None).astype(np.int64)
    last = np.clip(np.floor((splats.means2d + splats.edges) / TILE), None, (size - 1) // TILE).astype(
        np.int64
    )
    counts = np.maximum(last - first + 1, 0)
    each = counts.prod(1)
    member = np.repeat(np.arange(len(each)), each)
    within = np.arange(len(member)) - np.repeat(np.cumsum(each) - each, each)
    column, row = (
        first[member, 0] + within % counts[member, 0],
        first[member, 1] + within // counts[member, 0],
    )
    columns = -(-camera.width // TILE)
    tile = row * columns + column
    order = np.argsort(tile, kind="stable")  # members stay near to far
    starts = np.flatnonzero(np.diff(tile[order], prepend=-1))
    ends = [*starts[1:], len(order)][: len(starts)]
    for start, end in zip(starts, ends, strict=True):
        members, number = member[order[start:end]], tile[order[start]]
        x0, y0 = TILE * (number % columns), TILE * (number // columns)
        yield Tile(x0, y0, min(TILE, camera.width - x0), min(TILE, camera.height - y0), members)


def composite(splats: Splats, tile: Tile) -> np.ndarray:
    """[P, 5] sums over the Gaussians of the tile: share times `values`."""
    passed = np.ones((1, tile.width * tile.height), splats.conics.dtype)
    total = np.zeros((passed.size, 5), passed.dtype)
    for start in range(0, len(tile.members), AT_ONCE):
        members = tile.members[start : start + AT_ONCE]
        shares, passed = blend(pixel_alphas(splats, members, tile), passed)
        total += shares.T @ splats.values[members]
        if not (passed >= TRANSMITTANCE_MIN).any():
            break
    return total


def pixel_alphas(splats: Splats, members: np.ndarray, tile: Tile) -> np.ndarray:
    """[K, P] opacity of each member at the tile's pixel centres; 0 below 1/255."""
    dtype = splats.conics.dtype.type
    dx = np.arange(tile.x0, tile.x0 + tile.width, dtype=dtype) + dtype(0.5) - splats.means2d[members, :1]
    dy = np.arange(tile.y0, tile.y0 + tile.height, dtype=dtype) + dtype(0.5) - splats.means2d[members, 1:]
    a, b, c = (splats.conics[members, i, None] for i in range(3))
    along, across = -dtype(0.5) * a * dx * dx, -dtype(0.5) * c * dy * dy
    exponent = across[:, :, None] + along[:, None] - (b * dy)[:, :, None] * dx[:, None]
    alphas = splats.opacities[members, None, None] * np.exp(exponent)
    np.minimum(alphas, dtype(ALPHA_MAX), out=alphas)
    alphas[alphas < ALPHA_MIN] = 0
    return alphas.reshape(len(members), -1)


def blend(alphas: np.ndarray, passed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares [K, P] of Gaussians behind what let `passed` [1, P] through, and what then is let through.

    The Gaussian that would take the transmittance below 1e-4, and all behind it, get nothing.
    """
    through = np.cumprod(np.concatenate([passed, 1 - alphas]), 0)
    return alphas * through[:-1] * (through[1:] >= TRANSMITTANCE_MIN), through[-1:]
