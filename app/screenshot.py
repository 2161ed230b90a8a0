"""One picture of the window as a PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.errors import ArgumentError
from cap4d.player.png import write_png

MOST = 100_000  # numbers tried for a free name


def save_screenshot(folder: str | Path, image: np.ndarray, *, name: str = "cap4d") -> Path:
    """Writes `NAME_0001.png`, or the next number that is free; the file appears whole or not at all.

    Args:
        folder: Exists.
        image: uint8[H, W, 3], or uint8[H, W, 4] with straight alpha (`straight`), row 0 on top.
        name: What the file's name starts with.
    Returns:
        The file.
    Raises:
        ArgumentError: The folder is none, it is full, or nothing can be written there.
    """
    path = free_path(Path(folder), name, ".png")
    try:
        write_png(path, image)
    except OSError as error:
        raise ArgumentError(f"screenshot: {path} cannot be written: {error.strerror}") from error
    return path


def free_path(folder: Path, name: str, suffix: str) -> Path:
    """The first of `NAME_0001SUFFIX`, `NAME_0002SUFFIX`, ... that no file has.

    Raises:
        ArgumentError: There is no such folder, or no such name.
    """
    if not folder.is_dir():
        raise ArgumentError(f"{name}: the folder {folder} does not exist")
    taken = {entry.name for entry in folder.iterdir()}
    for number in range(1, MOST):
        candidate = f"{name}_{number:04d}{suffix}"
        if candidate not in taken:
            return folder / candidate
    raise ArgumentError(f"{name}: expected a free name in {folder}, got none among {MOST}")


def straight(premultiplied: np.ndarray) -> np.ndarray:
    """float[H, W, 4] premultiplied in [0, 1], or uint8 -> uint8[H, W, 4] with straight alpha.

    Colour where nothing is seen is black. One less than opaque stays what it is to half a level of alpha.
    """
    values = premultiplied.astype(np.float32)
    if premultiplied.dtype == np.uint8:
        values /= 255
    alpha = np.clip(values[..., 3:], 0, 1)
    values[..., :3] /= np.maximum(alpha, 1e-6)
    values[..., :3] *= alpha > 0
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
