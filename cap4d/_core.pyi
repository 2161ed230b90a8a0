"""The C++ extension. Arrays must have the dtype named here and be C-contiguous: nothing is converted."""

from collections.abc import Mapping
from typing import ClassVar, Literal, final

import numpy as np
from numpy.typing import NDArray

_F32 = NDArray[np.float32]
_F64 = NDArray[np.float64]
_I32 = NDArray[np.int32]

def rasterize_mesh(
    xyz: _F64,
    faces: _I32,
    height: int,
    width: int,
    cull: Literal["none", "clockwise", "counter_clockwise"] = "none",
) -> tuple[_I32, _F64]:
    """xyz [V, 3] px, px, depth -> triangle per pixel [H, W] (-1: none) and its barycentrics [H, W, 3]."""

def sort_by_depth(means: _F32, viewmat: _F32, threads: int = 0) -> NDArray[np.uint32]:
    """Order [N] of means [N, 3] near to far along viewmat [4, 4]; stable. Non-finite come last."""

def bind(
    vertices: _F32, faces: _I32, means: _F32, quats: _F32, log_scales: _F32, binding: _I32, threads: int = 0
) -> tuple[_F32, _F32, _F32]:
    """vertices [G, 3], faces [M, 3], local Gaussians -> posed means [N, 3], quats [N, 4], scales [N, 3]."""

def bind_vjp(
    vertices: _F32,
    faces: _I32,
    means: _F32,
    quats: _F32,
    log_scales: _F32,
    binding: _I32,
    v_means: _F32,
    v_quats: _F32,
    v_scales: _F32,
    threads: int = 0,
) -> tuple[_F32, _F32, _F32, _F32]:
    """Gradients of `bind`'s outputs -> those of vertices [G, 3], means, quats, log_scales [N, ...]."""

def render(
    means: _F32,
    quats: _F32,
    scales: _F32,
    opacities: _F32,
    sh: _F32,
    viewmat: _F64,
    K: _F64,
    width: int,
    height: int,
    background: tuple[float, ...] | None = None,
    sh_degree: int = -1,
    threads: int = 0,
) -> tuple[_F32, _F32, _F32]:
    """Forward only: rgb [H, W, 3], alpha [H, W], expected depth [H, W]. sh_degree -1: all that sh holds."""

@final
class Rendered:
    """What `rasterize` leaves for `rasterize_vjp`."""

    @property
    def drawn(self) -> int:
        """Gaussians that meet the image."""
    @property
    def pairs(self) -> int:
        """Tile-Gaussian pairs."""

def rasterize(
    means: _F32,
    quats: _F32,
    scales: _F32,
    opacities: _F32,
    sh: _F32,
    viewmat: _F64,
    K: _F64,
    width: int,
    height: int,
    background: tuple[float, ...] | None = None,
    sh_degree: int = -1,
    threads: int = 0,
) -> tuple[_F32, _F32, _F32, _F32, _I32, Rendered]:
    """`render`, then means2d [N, 2] px, radii [N] px (0: not drawn) and what the gradient needs."""

def rasterize_vjp(
    rendered: Rendered,
    means: _F32,
    quats: _F32,
    scales: _F32,
    opacities: _F32,
    sh: _F32,
    sh_degree: int,
    rgb: _F32,
    alpha: _F32,
    depth: _F32,
    v_rgb: _F32,
    v_alpha: _F32 | None,
    v_depth: _F32 | None,
    threads: int = 0,
) -> tuple[_F32, _F32, _F32, _F32, _F32, _F32]:
    """Gradients of means, quats, scales, opacities, sh and means2d."""

@final
class QuantizedUnet:
    """The deformation network in 8-bit integers (`bundle.quantized_unet` has the tensors' meaning).

    The same bits for any thread count and on every instruction set. Calls from several threads wait for each
    other.
    """

    isa: ClassVar[Literal["base", "v3", "avxvnni", "v4", "vnni"]]
    """The variant of the inner loops in use."""

    def __init__(self, tensors: Mapping[str, NDArray[np.generic]], size: int) -> None:
        """For a grid of `size` px. ValueError: a tensor is missing, or of a wrong dtype or shape."""
    @property
    def size(self) -> int: ...
    def run(self, offsets: _F32, threads: int = 0) -> _F32:
        """offsets [3, S, S] m -> deformation [3, S, S] m. ValueError: a number is not finite."""

def isa() -> Literal["base", "v3", "v4"]:
    """The x86-64 level of the inner loops in use (CAP4D_ISA asks for a lower one)."""

def default_threads() -> int:
    """What `threads=0` means: the hardware's, or CAP4D_THREADS."""
