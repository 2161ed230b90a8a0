"""Differentiable splatting in torch: one call, three backends with one meaning.

`cpu` is the tiled C++ renderer, `gsplat` its CUDA counterpart, `reference` the readable float64 form of both.
"""

from cap4d.raster.rasterize import Rasterized, rasterize

__all__ = ["Rasterized", "rasterize"]
