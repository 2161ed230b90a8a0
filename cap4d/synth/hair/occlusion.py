"""How much light reaches each place in a head of hair, from a few sides: deep opacity on a coarse grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CELL = 0.005  # m
REACH = 26  # cells that a ray is followed
STRAND_WIDTH = 9e-5  # m; of the hair that shades, not of what is drawn
EXTINCTION = 0.3  # share of the geometric coverage that takes light away: the rest is scattered on
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 3**0.5
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3), _CORNERS])
"""[D, 3] unit, in the head's own axes (the rig's)."""


@dataclass(frozen=True, eq=False)
class Openness:
    """Share of light that gets through to the cells of a grid, from each of DIRECTIONS.

    Args:
        low: [3] the grid's first corner, m.
        through: float32[X, Y, Z, D].
    """

    low: np.ndarray
    through: np.ndarray

    def at(self, points: np.ndarray) -> np.ndarray:
        """float32[..., D] of points [..., 3]; beyond the grid all light gets through."""
        place = (points.reshape(-1, 3) - self.low) / CELL - 0.5
        base = np.floor(place).astype(np.int64)
        part = (place - base).astype(np.float32)
        size = np.array(self.through.shape[:3])
        inside = ((base >= 0) & (base < size - 1)).all(1)
        flat = self.through.reshape(-1, len(DIRECTIONS))
        found = np.ones((len(place), len(DIRECTIONS)), np.float32)
        found[inside] = 0
        for corner in np.ndindex(2, 2, 2):
            weight = np.where(corner, part, 1 - part).prod(1)[inside]
            cell = base[inside] + corner
            found[inside] += (
                weight[:, None] * flat[(cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]]
            )
        return found.reshape(*points.shape[:-1], -1)


def openness(strands: np.ndarray, share: float, solid) -> Openness:
    """Of strands [K, P, 3] m, each of which stands for `share` real ones.

    Args:
        solid: Points [N, 3] -> bool[N], whether they lie in the head.
    """
    low = strands.min((0, 1)) - 3 * CELL
    size = np.ceil((strands.max((0, 1)) + 3 * CELL - low) / CELL).astype(int)
    middle = (strands[:, 1:] + strands[:, :-1]).reshape(-1, 3) / 2
    length = np.linalg.norm(np.diff(strands, axis=1), axis=-1).ravel()
    cell = np.floor((middle - low) / CELL).astype(int)
    flat = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    density = np.bincount(flat, length, size.prod()) * share * STRAND_WIDTH / CELL**2 * EXTINCTION
    density = _blurred(density.reshape(size))
    near = np.argwhere(_grown(density > 0))
    blocked = solid(low + (near + 0.5) * CELL)
    dense = density.astype(np.float32)
    dense[tuple(near[blocked].T)] = 3.0
    through = np.ones((*size, len(DIRECTIONS)), np.float32)
    through[tuple(near.T)] = _march(dense, near)
    return Openness(low, through)


def _blurred(values: np.ndarray) -> np.ndarray:
    for axis in range(3):
        values = 0.5 * values + 0.25 * (np.roll(values, 1, axis) + np.roll(values, -1, axis))
    return values


def _grown(filled: np.ndarray) -> np.ndarray:
    grown = filled.copy()
    for axis in range(3):
        for shift in (-1, 1):
            grown |= np.roll(filled, shift, axis)
    return grown


def _march(dense: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """float32[N, D] light that reaches cells [N, 3] through optical depths `dense` [X, Y, Z] per cell."""
    size = np.array(dense.shape)
    flat, through = dense.ravel(), np.zeros((len(cells), len(DIRECTIONS)), np.float32)
    for d, direction in enumerate(DIRECTIONS):
        depth = 0.5 * flat[(cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]]
        for k in range(1, REACH):
            at = np.floor(cells + 0.5 + k * direction).astype(int)
            inside = ((at >= 0) & (at < size)).all(1)
            index = ((at[:, 0] * size[1] + at[:, 1]) * size[2] + at[:, 2])[inside]
            depth[inside] += flat[index]
        through[:, d] = np.exp(-depth)
    return through


def weights_towards(direction: np.ndarray) -> np.ndarray:
    """float32[D] weights that mix the directions to one [3], unit."""
    weights = np.clip(DIRECTIONS @ direction, 0, None) ** 4
    return (weights / weights.sum()).astype(np.float32)
