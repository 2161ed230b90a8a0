"""Colours for values: equal steps look equal, and lighter is more.

Every 16th of the 256 colours of matplotlib's `viridis` and `magma` (van der Walt and Smith, CC0); in between
colours are linear, which differs from the tables by 0.02 at most.
"""

from __future__ import annotations

import numpy as np

_HEX = {
    "viridis": (
        "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c "
        "1fa088 28ae80 3fbc73 5ec962 84d44b addc30 d8e219 fde725"
    ),
    "magma": (
        "000004 0a0822 1d1147 36106b 51127c 6a1c81 832681 9c2e7f b73779 "
        "d0416f e75263 f56b5c fc8961 fea772 fec488 fde2a3 fcfdbf"
    ),
}


def color_map(name: str) -> np.ndarray:
    """uint8[17, 3] sRGB of `viridis` or `magma`, from nothing to the most."""
    return np.array([list(bytes.fromhex(color)) for color in _HEX[name].split()], np.uint8)
