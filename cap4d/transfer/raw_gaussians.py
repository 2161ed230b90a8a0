"""Raw Gaussians from elsewhere: what a bundle may hold of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cap4d.bundle.schema import GAUSSIANS, TENSORS
from cap4d.errors import DataError

SMALLEST_NORM = 1e-6  # of a quaternion


def check_gaussians(path: Path, arrays: Mapping[str, tuple[str, np.ndarray]]) -> None:
    """Refuses what no bundle may hold.

    Args:
        path: Where they are from.
        arrays: What they are called there -> the tensor's name in a bundle, and its finite values, of any
            shape; quats [N, 4].
    Raises:
        DataError: A number is beyond its limits, or a quaternion has no direction.
    """
    for field, (name, values) in arrays.items():
        spec = TENSORS[GAUSSIANS][name]
        low, high = values.min(initial=spec.low), values.max(initial=spec.high)
        if low < spec.low or high > spec.high:
            expected = f"numbers in [{spec.low:g}, {spec.high:g}]"
            raise DataError(path, field, expected=expected, found=low if low < spec.low else high)
        if name == "quats":
            _check_directions(path, field, values)


def _check_directions(path: Path, field: str, quats: np.ndarray) -> None:
    norms = np.linalg.norm(quats.astype(np.float64), axis=1)
    if norms.min(initial=1) < SMALLEST_NORM:
        expected = f"quaternions with norms of at least {SMALLEST_NORM:g}"
        raise DataError(path, field, expected=expected, found=norms.min())
