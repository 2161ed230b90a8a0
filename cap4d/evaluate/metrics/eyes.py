"""What landmarks say about eyes: where they look, and how far they are open."""

from __future__ import annotations

import numpy as np

# Of each eye as p1 to p6 of Soukupová & Čech 2016: a corner, two upper, the other corner, two lower.
EYES = ((33, 160, 158, 133, 153, 144), (362, 385, 387, 263, 373, 380))
IRISES = ((468, 469, 470, 471, 472), (473, 474, 475, 476, 477))
"""The centre and four points around it, of the right and the left eye."""
IRIS_DIAMETER, EYE_RADIUS = 11.7, 12.0  # mm; they differ by 4 % from adult to adult


def aspect_ratios(points: np.ndarray) -> np.ndarray:
    """[2] the eyes' heights over their widths of landmarks [478, 2]; about 0.3 open, under 0.15 shut.

    Soukupová & Čech 2016, "Real-Time Eye Blink Detection using Facial Landmarks", eq. 1.
    """
    p = points[np.array(EYES)]
    heights = np.linalg.norm(p[:, [1, 2]] - p[:, [5, 4]], axis=-1).sum(1)
    return heights / np.maximum(2 * np.linalg.norm(p[:, 0] - p[:, 3], axis=-1), 1e-9)


def iris_diameters(points: np.ndarray) -> np.ndarray:
    """[2] px: twice the largest distance of a rim point, as foreshortening only shortens."""
    p = points[np.array(IRISES)]
    return 2 * np.linalg.norm(p[:, 1:] - p[:, :1], axis=-1).max(1)


def gazes(points: np.ndarray, diameters: np.ndarray) -> np.ndarray:
    """[2, 3] unit vectors, each in its eye's own frame: along the corners, across them, out of the eye.

    An iris whose centre is d mm off the middle of the corners looks asin(d / 12 mm) away from straight on.

    Args:
        diameters: [2] px, of the irises, which give the scale.
    """
    p, centres = points[np.array(EYES)], points[[iris[0] for iris in IRISES]]
    along = p[:, 3] - p[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = along[:, ::-1] * [-1, 1]
    off = centres - (p[:, 0] + p[:, 3]) / 2
    scale = IRIS_DIAMETER / EYE_RADIUS / np.maximum(diameters, 1e-9)
    flat = np.stack([(off * along).sum(1), (off * across).sum(1)], 1) * scale[:, None]
    flat /= np.maximum(1, np.linalg.norm(flat, axis=1, keepdims=True))
    return np.concatenate([flat, np.sqrt(np.maximum(0, 1 - (flat**2).sum(1, keepdims=True)))], 1)
