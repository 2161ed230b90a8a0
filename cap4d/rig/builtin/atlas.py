"""Where each part lies in the UV square: one face, and below it a band with everything else, apart by
gutters.
"""

from __future__ import annotations

import numpy as np

from cap4d.rig.builtin.sheet import Part

PIXELS = 128  # the atlas is laid out for a grid of this many pixels a side; gutters are 2 of them
# x0, y0, x1, y1 in those pixels, y up: one rectangle for a part with a midline, two (left, right) for a pair.
# Edges that
# should appear in the grid lie a hair outside pixel centres.
PLACES = {
    "skin": ((0.48, 40, 127.52, 127),),
    "hair": ((0.48, 0.48, 41.52, 37.52),),
    "shirt": ((44.48, 0.48, 73.52, 37.52),),
    "eye": ((110, 19.5, 127.6, 37.6), (90.4, 19.5, 108, 37.6)),
    "ear": ((110.48, 0.48, 127.52, 16.52), (90.48, 0.48, 107.52, 16.52)),
    "mouth": ((76.48, 26.48, 87.52, 37.52),),
    "teeth_upper": ((76.48, 18.48, 87.52, 23.52),),
    "teeth_lower": ((76.48, 10.48, 87.52, 15.52),),
    "tongue": ((76.48, 0.48, 87.52, 7.52),),
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
