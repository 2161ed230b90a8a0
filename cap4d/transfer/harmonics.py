"""Spherical harmonics seen from another frame."""

from __future__ import annotations

import numpy as np
import torch

from cap4d.gaussians import SH_COUNTS
from cap4d.raster.reference import sh_basis

DIRECTIONS = 64  # that determine up to 16 harmonics with room to spare


def turned_harmonics(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """What gives in direction d what `sh` gives in direction `rotation` d.

    A rotation maps harmonics of a degree to harmonics of that degree, exactly; the matrix is found from
    values in some directions.

    Args:
        sh: float32[N, S, 3].
        rotation: [3, 3].
    """
    degree = SH_COUNTS[sh.shape[1]]
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = (
        sh_basis(torch.from_numpy(np.ascontiguousarray(d)), degree).numpy()
        for d in (directions, directions @ rotation.T)
    )
    mixing = np.linalg.lstsq(here, there, rcond=None)[0]
    return np.einsum("ij,njc->nic", mixing, sh.astype(np.float64)).astype(np.float32)
