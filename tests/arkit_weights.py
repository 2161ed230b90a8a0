"""Apple's 52 weights of a face of which a few are told."""

from __future__ import annotations

import numpy as np

from cap4d.drive.arkit import COLUMN, NAMES


def arkit_weights(**values: float) -> np.ndarray:
    """float32[52]: those named, 0 for the others."""
    found = np.zeros(len(NAMES), np.float32)
    for name, value in values.items():
        found[COLUMN[name]] = value
    return found
