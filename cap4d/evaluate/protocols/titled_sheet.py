"""Pictures in rows and columns under their titles, as one PNG."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.atomic import replacing
from cap4d.capture.image import read_image

DPI = 100
TILE = 192  # px: every picture's side on the sheet
HEADER = 58  # px
MARGIN = 22  # px, left, for the rows' titles
INK = "#222222"


def draw_sheet(path: Path, titles: Sequence[str], rows: Sequence[tuple[str, Mapping[str, Path]]]) -> None:
    """Draws a picture per title in every row that has one.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    width, height = MARGIN + TILE * len(titles), HEADER + TILE * len(rows)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    for j, title in enumerate(titles):
        place = (MARGIN + TILE * (j + 0.5)) / width, 1 - HEADER / 2 / height
        text = "\n".join(textwrap.wrap(title, 26))
        figure.text(*place, text, ha="center", va="center", fontsize=8, color=INK)
    for i, (title, pictures) in enumerate(rows):
        middle = 1 - (HEADER + TILE * (i + 0.5)) / height
        figure.text(MARGIN / 2 / width, middle, title, rotation=90, ha="center", va="center", fontsize=6)
        for j, name in enumerate(titles):
            if name in pictures:
                box = (MARGIN + TILE * j, height - HEADER - TILE * (i + 1), TILE, TILE)
                _place(figure, box, (width, height), read_image(pictures[name])[..., :3])
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI, format="png")


def _place(figure: Any, box: tuple[int, int, int, int], size: tuple[int, int], image: np.ndarray) -> None:
    x, y, w, h = box
    axes = figure.add_axes((x / size[0], y / size[1], w / size[0], h / size[1]))
    axes.imshow(np.clip(image, 0, 1), interpolation="lanczos")
    axes.set_axis_off()
