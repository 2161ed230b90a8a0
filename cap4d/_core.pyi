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

def gradient_noise(points: _F32, seed: int) -> _F32:
    """points [N, 3] in units of the lattice -> Perlin's noise [N] in about [-1, 1]."""

def cellular_noise(points: _F32, seed: int) -> tuple[_F32, _F32]:
    """points [N, 3] in units of a cell -> distance [N] to the nearest feature, and its own number [N]."""

def light_surface(
    face: _I32,
    bary: _F64,
    faces: _I32,
    uv_faces: _I32,
    positions: _F32,
    normals: _F32,
    soft: _F32,
    depths: _F32,
    open: _F32,
    visible: _F32,
    uvs: _F32,
    texture: _F32,
    directions: _F32,
    colors: _F32,
    sky: _F32,
    ground: _F32,
    up: _F32,
    eye: _F32,
) -> tuple[_F32, _F32]:
    """What rasterize_mesh saw, in light: linear rgb [H, W, 3] and depth [H, W]; see lit_surface.h."""

def sort_by_depth(means: _F32, viewmat: _F32, threads: int = 0) -> NDArray[np.uint32]:
    """Order [N] of means [N, 3] near to far along viewmat [4, 4]; stable. Non-finite come last."""

def draw_strands(xyz: _F32, rgba: _F32, widths: _F32, depth: _F32, softness: float) -> tuple[_F32, _F32]:
    """K strands of P points: xyz [K, P, 3] px, px, depth; rgba [K, P, 4]; widths [K, P] px, in front of depth
    [H, W] -> premultiplied rgb [H, W, 3] and what is still seen behind [H, W].
    """

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

def similarity(image: _F32, target: _F32, threads: int = 0) -> tuple[float, float, _F32]:
    """Two images [H, W, C] -> mean absolute difference, mean SSIM, [3, H, W, C] that the gradient needs."""

def similarity_vjp(
    image: _F32, target: _F32, partials: _F32, v_absolute: float, v_structural: float, threads: int = 0
) -> _F32:
    """Gradient [H, W, C] of the image from those of `similarity`'s two means."""

_Layers = list[tuple[_F32, _F32]]

@final
class UnetPass:
    """The deformation network there and back, for fitting; what the way back needs stays in it.

    The same bits for any number of threads. Not for several threads at once.
    """

    def __init__(self, width: int, batch: int, encoding: _F32) -> None:
        """encoding [C, S, S]: what the first layer sees behind the offsets. ValueError: a size is wrong."""
    @property
    def size(self) -> int: ...
    @property
    def batch(self) -> int: ...
    @property
    def depth(self) -> int: ...
    def forward(self, offsets: _F32, down: _Layers, up: _Layers, threads: int = 0) -> _F32:
        """offsets [B, 3, S, S], weights and biases, the outermost first -> answer [B, 3, S, S]."""
    def backward(self, v_out: _F32, threads: int = 0) -> tuple[_Layers, _Layers]:
        """Gradients of all weights and biases, after `forward`."""

class _Unet:
    def __init__(self, tensors: Mapping[str, NDArray[np.generic]], size: int) -> None:
        """For a grid of `size` px. ValueError: a tensor is missing, or of a wrong dtype or shape."""
    @property
    def size(self) -> int: ...
    def run(self, offsets: _F32, threads: int = 0, out: _F32 | None = None) -> _F32:
        """offsets [3, S, S] m -> deformation [3, S, S] m, written into `out` if given.

        ValueError: a number is not finite.
        """

@final
class QuantizedUnet(_Unet):
    """The deformation network in 8-bit integers (`bundle.quantized_unet` has the tensors' meaning).

    The same bits for any thread count and on every instruction set. Calls from several threads wait for each
    other.
    """

    isa: ClassVar[Literal["base", "v3", "avxvnni", "v4", "vnni"]]
    """The variant of the inner loops in use."""

@final
class FloatUnet(_Unet):
    """The deformation network in float32 (`bundle.float_unet` has the tensors' meaning).

    The same bits for any thread count; instruction sets differ by rounding. Calls from several threads wait
    for each other.
    """

    isa: ClassVar[Literal["base", "v3", "v4"]]
    """The variant of the inner loops in use."""

@final
class Splatter:
    """N Gaussians prepared for drawing again and again, with half-precision colours.

    Activated Gaussians as of `render`; with `binding` [N] they stand in the frames of `faces` [M, 3].
    """

    def __init__(
        self,
        means: _F32,
        quats: _F32,
        scales: _F32,
        opacities: _F32,
        sh: _F32,
        binding: _I32 | None = None,
        faces: _I32 | None = None,
    ) -> None: ...
    def draw(
        self,
        out: NDArray[np.uint8],
        viewmat: _F64,
        K: _F64,
        background: tuple[float, ...] | None = None,
        vertices: _F32 | None = None,
        threads: int = 0,
        premultiplied: bool = False,
    ) -> None:
        """Into out uint8[H, W, 4]: on a background with alpha 255, else straight unless asked otherwise."""
    def count(self, out: NDArray[np.uint16], threads: int = 0) -> None:
        """Into out uint16[H, W]: how many Gaussians each pixel of the last picture takes, hidden ones too."""
    def render(
        self,
        viewmat: _F64,
        K: _F64,
        width: int,
        height: int,
        background: tuple[float, ...] | None = None,
        vertices: _F32 | None = None,
        threads: int = 0,
    ) -> tuple[_F32, _F32, _F32]:
        """The picture as `_core.render` gives it."""
    def order(self, viewmat: _F64, vertices: _F32 | None = None, threads: int = 0) -> NDArray[np.uint32]:
        """[N] near to far; equal depths keep their order, non-finite ones come last."""
    def __len__(self) -> int: ...
    @property
    def drawn(self) -> int:
        """Gaussians that met the last picture."""
    @property
    def pairs(self) -> int:
        """Tile-Gaussian pairs of the last picture."""
    @property
    def bytes(self) -> int:
        """Memory held."""
    @property
    def seconds(self) -> dict[str, float]:
        """Of the last picture or order: bind, project, sort, tiles, rasterize."""

@final
class GridSurface:
    """The head on the grid's G vertices: basis [K, G, 3] (expressions, correctives), skin_weights [J, G]."""

    def __init__(
        self,
        neutral: _F32,
        basis: _F32,
        skin_weights: _F32,
        pixels: _I32,
        size: int,
        deformable: NDArray[np.bool_],
        deform_neutral: _F32,
    ) -> None: ...
    def pose(
        self,
        vertices: _F32,
        offsets: _F32 | None,
        coefficients: _F32,
        late: _F32,
        turns: list[tuple[int, bool, _F32, _F32]],
        rest: _F32 | None,
        threads: int = 0,
    ) -> None:
        """Writes vertices [G, 3] and the network's offsets [3, S, S] (from rest [G, 3]); see grid_surface.h.

        turns: (joint, late, R - I [3, 3], pivot [3]); what is late does not show in the offsets.
        """
    def deform(self, vertices: _F32, answer: _F32 | None, threads: int = 0) -> None:
        """Adds the network's answer [3, S, S] where deformable, else the neutral correction."""

def isa() -> Literal["base", "v3", "v4"]:
    """The x86-64 level of the inner loops in use (CAP4D_ISA asks for a lower one)."""

def default_threads() -> int:
    """What `threads=0` means: the hardware's, or CAP4D_THREADS."""

def multiply_add_rate(threads: int, seconds: float = 0.3) -> float:
    """The machine's float32 operations a second; a multiply-add is two. Best of about `seconds`."""

def copy_rate(bytes: int, threads: int, seconds: float = 0.3) -> float:
    """Bytes read and written a second by copies that touch `bytes` in all."""

def read_rate(bytes: int, threads: int, seconds: float = 0.3) -> float:
    """Bytes a second of reading `bytes` again and again."""

def sort_pass_rate(count: int, threads: int, seconds: float = 0.3) -> float:
    """Keys a second through one pass of an 8-bit radix sort of `count` keys and values a thread."""
