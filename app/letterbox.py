"""A picture fitted into a frame of another shape: the smaller scale, centred, on black."""

from __future__ import annotations

import numpy as np

SMALLEST = 16  # px a side; below, rows and columns are repeated, which the scaler of FFmpeg refuses to do


def letterboxed(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8[H, W, 3 | 4] -> uint8[height, width, 3 | 4]; the picture itself where it fits as it is."""
    width, height = size
    if image.shape[:2] == (height, width):
        return image
    scale = min(width / image.shape[1], height / image.shape[0])
    inner = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    out = np.zeros((height, width, image.shape[2]), np.uint8)
    left, top = (width - inner[0]) // 2, (height - inner[1]) // 2
    out[top : top + inner[1], left : left + inner[0]] = scaled(image, inner)
    return out


def scaled(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8[H, W, C] -> uint8[height, width, C], averaging where it shrinks."""
    height, width = image.shape[:2]
    if min(height, width, *size) < SMALLEST:
        rows = (np.arange(size[1]) + 0.5) * height / size[1]
        columns = (np.arange(size[0]) + 0.5) * width / size[0]
        return image[rows.astype(int)[:, None], columns.astype(int)]
    import av
    from av.video.reformatter import Interpolation

    layout = "rgba" if image.shape[2] == 4 else "rgb24"
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=layout)
    return frame.reformat(width=size[0], height=size[1], interpolation=Interpolation.AREA).to_ndarray()
