"""Where each part lies in the UV square: one face, and below it a band with everything else, apart by gutters."""

from __future__ import annotations

import numpy as np

from cap4d.rig.builtin.sheet import Part

PIXELS = 128  # the atlas is laid out for a grid of this many pixels a side; gutters are 2 of them or more
# x0, y0, x1, y1 in those pixels, y up: one rectangle for a part with a midline, two (left, right) for a pair.
PLACES = {
    "skin": ((1, 40, 127, 127),),
    "hair": ((1, 1, 41, 37.5),),
    "shirt": ((43.5, 1, 73.5, 37.5),),
    "eye": ((109.5, 19.5, 127, 37.5), (89.5, 19.5, 107, 37.5)),
    "ear": ((109.5, 1, 127, 17), (89.5, 1, 107, 17)),
    "mouth": ((75.5, 26, 87.5, 37.5),),
    "teeth_upper": ((75.5, 18.2, 87.5, 23.8),),
    "teeth_lower": ((75.5, 10.4, 87.5, 16),),
    "tongue": ((75.5, 1, 87.5, 8.2),),
}


def _into(uv: np.ndarray, place: tuple) -> np.ndarray:
    x0, y0, x1, y1 = (c / PIXELS for c in place)
    return uv * [x1 - x0, y1 - y0] + [x0, y0]


def left_uv(part: Part, uv: np.ndarray) -> np.ndarray:
    """[..., 2] a part's own uv in the unit square -> its place in the atlas."""
    return _into(uv, PLACES[part.name][0])


def right_uv(part: Part, uv: np.ndarray) -> np.ndarray:
    """The same for the mirrored half: across the part's midline, or in the partner's rectangle."""
    return _into([1, 0] + uv * [-1, 1], PLACES[part.name][-1])
