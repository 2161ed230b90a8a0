"""A picture for the eye: some views of an evaluation, truth beside avatar beside what they differ by."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.capture.image import write_image
from cap4d.evaluate.pair import Pair

ROWS, GAIN = 6, 4.0  # differences are drawn this many times as strong, on black


class Sheet:
    """Collects the rows of evenly spread views.

    Args:
        count: Of all views.
    """

    def __init__(self, count: int) -> None:
        self._wanted = frozenset(np.linspace(0, count - 1, min(ROWS, count)).round().astype(int).tolist())
        self._rows: list[np.ndarray] = []

    def add(self, index: int, pair: Pair) -> None:
        """Takes the pair, if it is one of those wanted."""
        if index in self._wanted:
            difference = np.clip(GAIN * np.abs(pair.image - pair.truth), 0, 1)
            self._rows.append(np.concatenate([pair.truth, pair.image, difference], 1))

    def write(self, path: Path) -> None:
        """Rows of several widths are filled up with white."""
        width = max(row.shape[1] for row in self._rows)
        filled = [
            np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=1) for row in self._rows
        ]
        write_image(path, np.concatenate(filled))
