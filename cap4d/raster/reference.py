"""Splatting as one reads it: float64, autograd, tile by tile, and no further shortcut. Seconds a picture.

The stages have the names and the order of src/cpp: `project`, `eval_sh`, `composite`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cap4d.camera import NEAR, Camera
from cap4d.harmonics import sh_basis
from cap4d.raster.rasterize import Rasterized, collecting_leaf
from cap4d.rotation import quat_to_rotmat

EPS2D = 0.3  # px^2; these constants are those of src/cpp/constants.h, where each has its provenance
JACOBIAN_MARGIN = 0.3
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
QUAT_MIN = 1e-12
DEPTH_MAX = 1e7  # m
COLOR_MAX = 1e6
RADIUS_SIGMAS = 3.0

PAIRS_AT_ONCE = 1 << 22
"""Pixel-Gaussian pairs held in memory together."""
TILE = 16  # px a side


@dataclass(frozen=True, eq=False)
class Projected:
    """V Gaussians that may be seen, near to far.

    Args:
        ids: int64[V] which of the N.
        means2d: [V, 2] px.
        conics: [V, 3] 1/px^2: a, b, c of the density exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2).
        depths: [V] m.
        radii: int32[V] px.
        edges: [V, 2] px, half the sides of the box around the outline, where alpha is 1/255.
    """

    ids: Tensor
    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor
    edges: Tensor


def rasterize_reference(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    *,
    camera: Camera,
    background: tuple[float, ...] | None,
    sh_degree: int,
    smooth_cutoff: float = 0.0,
) -> Rasterized:
    """`rasterize`, readable. The arguments are those of `rasterize`, checked; computes and returns float64.

    Args:
        smooth_cutoff: 0 is the real thing: contributions below 1/255 are skipped, a pixel ends at
            transmittance 1e-4 and alpha is clamped at 0.99. Positive: a twin without steps and kinks for
            finite differences, in which contributions fade in around 1/255 over this share of it, pixels
            never end, and alpha is 0.99 times the opacity times the density.
    """
    gaussians = tuple(x.double() for x in (means, quats, scales, opacities, sh))
    position = gaussians[0].new_tensor(camera.position)
    with torch.no_grad():
        keep = drawable(*gaussians[:4], eval_sh(gaussians[4], gaussians[0] - position, sh_degree), camera)
    # Only now with gradients: those of bad numbers would be 0 times them.
    means, quats, scales, opacities, sh = (x[keep] for x in gaussians)
    colors = eval_sh(sh, means - position, sh_degree)
    projected = project(means, quats, scales, opacities, camera=camera)
    ids, means2d = projected.ids, projected.means2d
    colors = colors[ids].clamp(min=0)
    rgb, alpha, depth = composite(
        means2d,
        projected.conics,
        opacities[ids],
        colors,
        projected.depths,
        camera=camera,
        edges=projected.edges if smooth_cutoff == 0 else None,
        smooth_cutoff=smooth_cutoff,
    )
    if background is not None:
        rgb = rgb + (1 - alpha)[..., None] * rgb.new_tensor(background)
    depth = torch.where(alpha > 0, depth / torch.where(alpha > 0, alpha, 1), 0)
    gaussian_from_projected = keep.nonzero()[:, 0][ids]
    radii = torch.zeros(len(keep), dtype=torch.int32)
    radii[gaussian_from_projected] = projected.radii
    leaf = collecting_leaf(means2d, gaussian_from_projected, len(keep))
    return Rasterized(rgb, alpha, depth, leaf, radii)


def drawable(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, camera: Camera
) -> Tensor:
    """bool[N]: finite in every field, in front of the camera, not too far away or too faint to see, and of
    a sane colour.
    """
    with torch.no_grad():
        depths = means @ means.new_tensor(camera.viewmat[2, :3]) + camera.viewmat[2, 3]
        fields = (means, quats, scales, opacities[:, None])
        finite = torch.stack([torch.isfinite(x).all(1) for x in fields]).all(0)
        placed = (depths >= NEAR) & (depths <= DEPTH_MAX)
        return finite & placed & (opacities >= ALPHA_MIN) & (colors.abs() <= COLOR_MAX).all(1)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, *, camera: Camera, eps2d: float = EPS2D
) -> Projected:
    """Projects Gaussians onto the image plane with the EWA approximation.

    Zwicker et al. 2002, eq. 31; the Jacobian is clamped at 1.3x the field of view (as in gsplat).

    Args:
        means, quats, scales, opacities: drawable Gaussians in world space, m.
        eps2d: Low-pass variance added to both image axes, px^2.
    Returns:
        Those whose outline (alpha = 1/255) meets the image, near to far; equal depths in their given order.
    """
    rotation, translation = (means.new_tensor(camera.viewmat[:3, i]) for i in (slice(3), 3))
    focal, centre = means.new_tensor(camera.K.diagonal()[:2]), means.new_tensor(camera.K[:2, 2])
    size = means.new_tensor([camera.width, camera.height])
    view = means @ rotation.T + translation
    x, z = view[:, :2], view[:, 2:]
    means2d = focal * x / z + centre
    margin = JACOBIAN_MARGIN * size / (2 * focal)
    clamped = (x / z).clamp(-centre / focal - margin, (size - centre) / focal + margin)
    # J = [f / z, 0, -f x / z^2; 0, f / z, -f y / z^2], applied to the rows of the rotation.
    jacobian_view = (focal / z)[..., None] * (rotation[:2] - clamped[..., None] * rotation[2])
    unit = torch.where(quats.abs().amax(1, keepdim=True) > QUAT_MIN, quats, quats.new_tensor([1.0, 0, 0, 0]))
    root = jacobian_view @ (quat_to_rotmat(unit) * scales[:, None])
    covariance = root @ root.mT + eps2d * torch.eye(2, dtype=means.dtype)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    det = torch.linalg.cross(root[:, 0], root[:, 1]).square().sum(-1) + eps2d * (xx + yy) - eps2d**2
    conics = torch.stack([yy, -xy, xx], 1) / det[:, None]
    with torch.no_grad():
        reach = (2 * torch.log(opacities / ALPHA_MIN))[:, None] * torch.stack([xx, yy], 1)
        edge = reach.sqrt()
        seen = ((means2d + edge > 0) & (means2d - edge < size)).all(1) & torch.isfinite(conics).all(1)
        ids = seen.nonzero()[:, 0]
        ids = ids[torch.argsort(z[ids, 0], stable=True)]
        longest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
        radii = (RADIUS_SIGMAS * longest.sqrt()).ceil().clamp(max=1e9).int()
    return Projected(ids, means2d[ids], conics[ids], z[ids, 0], radii[ids], edge[ids])


def eval_sh(sh: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colours [V, 3] = 0.5 + SH, before the clamp at 0.

    Args:
        sh: [V, S, 3] coefficients.
        directions: [V, 3] from the camera to the Gaussians, any length.
    """
    basis = sh_basis(directions / directions.norm(dim=1, keepdim=True), degree)
    return (basis[..., None] * sh[:, : (degree + 1) ** 2]).sum(1) + 0.5


def pixel_alphas(
    means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, *, smooth_cutoff: float = 0.0
) -> Tensor:
    """[P, V] opacity of each Gaussian at pixel centres [P, 2]."""
    dx, dy = (pixels[:, None] - means2d).unbind(-1)
    a, b, c = conics.unbind(1)
    density = torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
    if smooth_cutoff > 0:
        alphas = ALPHA_MAX * opacities * density
        return alphas * torch.sigmoid((alphas / ALPHA_MIN - 1) / smooth_cutoff)
    alphas = (opacities * density).clamp(max=ALPHA_MAX)
    return torch.where(alphas >= ALPHA_MIN, alphas, 0)


def blend_weights(alphas: Tensor, *, stop: bool = True) -> Tensor:
    """[P, V] share of each Gaussian, near to far, in each pixel: its alpha times what those before let pass.

    The Gaussian that would take the transmittance below 1e-4, and all behind it, are left out.
    """
    through = torch.cumprod(1 - alphas, 1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
    return alphas * before * (through >= TRANSMITTANCE_MIN) if stop else alphas * before


def composite(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    depths: Tensor,
    *,
    camera: Camera,
    edges: Tensor | None = None,
    smooth_cutoff: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Premultiplied rgb [H, W, 3], alpha [H, W], accumulated depth [H, W]; the Gaussians come near to far.

    Args:
        edges: See `Projected`; a tile leaves out those whose boxes it does not meet, which are 0 at all its
            pixels. None: every Gaussian at every pixel.
    """
    values = torch.cat([colors, torch.ones_like(colors[:, :1]), depths[:, None]], 1)
    image = values.new_zeros(camera.height, camera.width, 5)
    for rows, columns, ids in tiles(means2d, edges, camera):
        y, x = torch.meshgrid(torch.arange(rows.start, rows.stop), torch.arange(columns.start, columns.stop),
                              indexing="ij")  # fmt: skip
        pixels = torch.stack([x, y], -1).reshape(-1, 2).to(means2d) + 0.5
        blended = []
        for block in pixels.split(max(1, PAIRS_AT_ONCE // len(ids))):
            alphas = pixel_alphas(
                means2d[ids], conics[ids], opacities[ids], block, smooth_cutoff=smooth_cutoff
            )
            blended.append(blend_weights(alphas, stop=smooth_cutoff == 0) @ values[ids])
        image[rows, columns] = torch.cat(blended).reshape(*y.shape, 5)
    return image[..., :3], image[..., 3], image[..., 4]


@torch.no_grad()
def tiles(means2d: Tensor, edges: Tensor | None, camera: Camera) -> list[tuple[slice, slice, Tensor]]:
    """Rows, columns and the Gaussians int64[K >= 1], near to far, of each tile that any of them meets."""
    reach = torch.full_like(means2d, torch.inf) if edges is None else edges
    low, high = means2d - reach, means2d + reach
    met = []
    for rows in _spans(camera.height):
        across = ((low[:, 1] <= rows.stop) & (high[:, 1] >= rows.start)).nonzero()[:, 0]
        for columns in _spans(camera.width):
            inside = (low[across, 0] <= columns.stop) & (high[across, 0] >= columns.start)
            if inside.any():
                met.append((rows, columns, across[inside]))
    return met


def _spans(size: int) -> list[slice]:
    return [slice(start, min(start + TILE, size)) for start in range(0, size, TILE)]
