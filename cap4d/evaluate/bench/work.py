"""How much work a picture needs, counted exactly in float64: what a splatter cannot avoid."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from cap4d.camera import Camera
from cap4d.evaluate.bench.tiled import TILE, TRANSMITTANCE_MIN, Picture, Tile, pixel_alphas, project, tiles
from cap4d.gaussians import Gaussians

BLOCKS = {4: (4, 1), 8: (4, 2), 16: (4, 4)}  # lanes of a register -> columns and rows of the pixels it holds


@dataclass(frozen=True)
class Work:
    """Counts for one view of one scene.

    Args:
        gaussians, drawn: All, and those that meet the image.
        pairs: Tile-Gaussian pairs with a pixel centre inside the outline, tiles of 16 x 16.
        inside: Pixel-Gaussian pairs inside the outline (alpha >= 1/255).
        blended: Those of them before the pixel ends.
        lanes: Register width in floats -> lanes of all registers with a blended pixel, each holding a block
            of 4 columns. At least `blended`; the other lanes idle.
        pixels: Of the image.
        sh_count: Coefficients per channel.
    """

    gaussians: int
    drawn: int
    pairs: int
    inside: int
    blended: int
    lanes: dict[int, int]
    pixels: int
    sh_count: int

    def report(self) -> dict[str, object]:
        return asdict(self)


def count_work(gaussians: Gaussians, camera: Camera) -> tuple[Work, Picture]:
    """The counts, and the float64 picture that comes with them."""
    splats = project(gaussians, camera)
    image = np.zeros((camera.height, camera.width, 5))
    pairs = inside = blended = 0
    lanes = dict.fromkeys(BLOCKS, 0)
    for tile in tiles(splats, camera):
        alphas = pixel_alphas(splats, tile.members, tile)
        through = np.cumprod(1 - alphas, 0)
        lit = alphas > 0
        shown = lit & (through >= TRANSMITTANCE_MIN)
        before = np.concatenate([np.ones_like(through[:1]), through[:-1]])
        rows, columns = (slice(a, a + n) for a, n in ((tile.y0, tile.height), (tile.x0, tile.width)))
        sums = np.where(shown, alphas * before, 0).T @ splats.values[tile.members]
        image[rows, columns] = sums.reshape(tile.height, tile.width, 5)
        pairs += int(lit.any(1).sum())
        inside += int(lit.sum())
        blended += int(shown.sum())
        for width in BLOCKS:
            lanes[width] += width * touched_blocks(shown, tile, *BLOCKS[width])
    alpha = image[..., 3]
    depth = np.where(alpha > 0, image[..., 4] / np.where(alpha > 0, alpha, 1), 0)
    counts = Work(
        len(gaussians), len(splats.ids), pairs, inside, blended, lanes, alpha.size, gaussians.sh.shape[1]
    )
    return counts, Picture(image[..., :3], alpha, depth)


def touched_blocks(shown: np.ndarray, tile: Tile, columns: int, rows: int) -> int:
    """Over all Gaussians, the blocks of `columns` x `rows` pixels with at least one shown.

    Args:
        shown: bool[K, P].
    """
    whole = np.zeros((len(shown), TILE, TILE), bool)
    whole[:, : tile.height, : tile.width] = shown.reshape(-1, tile.height, tile.width)
    blocks = whole.reshape(-1, TILE // rows, rows, TILE // columns, columns)
    return int(blocks.any((2, 4)).sum())
