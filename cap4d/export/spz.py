"""Gaussians as an .spz, version 2 (Niantic): a tenth of a .ply, view-dependent colours included.

Gzip over a 16-byte header and then one array after another: positions in 24-bit fixed point, opacities,
colours, logarithms of scales, quaternions without w, and spherical harmonics, in a byte each. Harmonics are
rounded to 32 steps in degree 1 and to 16 above, as the format's own encoder does: gzip lives off it. Axes:
x right, y up, z back.

What is lost, at most: positions half a step (`position_bits`), scales 3.2 % (none below 0.045 mm), colours
0.0037, opacities 0.002, harmonics of degree 1 0.031 and of degrees 2 and 3 0.063 where they are within [-1,
0.93].
"""

from __future__ import annotations

import gzip
import struct

import numpy as np

from cap4d.errors import ArgumentError
from cap4d.export.axes import unit_quats, y_up
from cap4d.gaussians import Gaussians
from cap4d.rotation import quat_multiply

MAGIC, VERSION = 0x5053474E, 2
MOST_BITS = 20  # of fractions: 0.001 mm, as fine as float32 is half a metre away
COLOR_SCALE = 0.15
SMALLEST_LOG_SCALE, LOG_STEPS = -10.0, 16.0
SH_STEPS = (8, 16)  # of 256: degree 1, degrees above
LEVEL = 6


def spz_bytes(gaussians: Gaussians) -> bytes:
    """The file.

    Raises:
        ArgumentError: A Gaussian is 8 km away.
    """
    gaussians = y_up(gaussians)
    bits = position_bits(gaussians.means)
    header = struct.pack("<3I4B", MAGIC, VERSION, len(gaussians), gaussians.sh_degree, bits, 0, 0)
    scales = np.log(np.maximum(gaussians.scales.astype(np.float64), np.exp(SMALLEST_LOG_SCALE)))
    parts = [
        _fixed(gaussians.means, bits),
        _byte(255 * gaussians.opacities),
        _byte(255 * (0.5 + COLOR_SCALE * gaussians.sh[:, 0].astype(np.float64))),
        _byte(LOG_STEPS * (scales - SMALLEST_LOG_SCALE)),
        _byte(127.5 + 127.5 * _with_large_w(unit_quats(gaussians))[:, 1:]),
        _harmonics(gaussians.sh[:, 1:]),
    ]
    return gzip.compress(header + b"".join(part.tobytes() for part in parts), LEVEL, mtime=0)


def position_bits(means: np.ndarray) -> int:
    """How many of the 24 bits are fractions of a metre: as many as leave room for the furthest."""
    furthest = float(np.abs(means).max(initial=0))
    for bits in range(MOST_BITS, 9, -1):
        if np.round(furthest * 2**bits) < 1 << 23:
            return bits
    raise ArgumentError(f"spz: expected positions within 8 km, got {furthest:g} m")


def _fixed(means: np.ndarray, bits: int) -> np.ndarray:
    """uint8[N, 3, 3]: 24 bits, two's complement, the lowest byte first."""
    fixed = np.round(means.astype(np.float64) * 2**bits).astype("<i4")
    return np.ascontiguousarray(fixed).view(np.uint8).reshape(*means.shape, 4)[..., :3].copy()


def _with_large_w(quats: np.ndarray) -> np.ndarray:
    """The same Gaussians turned by half a turn about an axis of their own, or not, so that w is at least 1/2.

    They look the same, and the reader works out w of the others: near 0 it would be anything.
    """
    largest = np.abs(quats).argmax(1)
    halves = np.eye(4) * [1, -1, -1, -1]  # conjugates
    turned = quat_multiply(quats, halves[largest])
    return turned * np.where(turned[:, :1] < 0, -1, 1)


def _harmonics(rest: np.ndarray) -> np.ndarray:
    """uint8[N, S - 1, 3]"""
    step = np.where(np.arange(rest.shape[1]) < 3, *SH_STEPS)[:, None]
    return _byte(np.round((128 * rest.astype(np.float64) + 128) / step) * step)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
