"""What a fitted avatar pays for: unlike pixels, stray Gaussians, rough or needless deformation.

Facts 33-35.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F

from cap4d.avatar.deformer import DEFORM_STD
from cap4d.avatar.similarity import l1_and_ssim

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # Wang et al. 2004, sec. III-B
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # their K1, K2 at a dynamic range of 1
BLUR_LANES = 16  # channels that one AVX-512 register holds; depthwise kernels are fast on whole ones


@dataclass(frozen=True)
class LossWeights:
    """Weights and thresholds of every term; those of facts 33-35 are the released system's.

    Args:
        l1, dssim: Photometric mixture, 0.6 L1 + 0.4 (1 - SSIM).
        l2: Mean squared error beside it, which turns first to what is far off. 0 in the released system.
        matte: L1 of the rendered coverage against the matte; without it white Gaussians may stand in for
            background.
        position, position_limit: Local means beyond the limit (face sizes).
        scale, scale_limit: Local scales beyond the limit (face sizes).
        laplacian: Roughness of the deformation map.
        deformation: Size of its expression-dependent part.
        rotation: Turning of the triangles by that part.
        pose: Learned corrections of head pose, expression, eyes and neck, or neck offsets.
        measures: `released`: local means by their length, the deformation's size on the Gaussians, and its
            roughness on the map that moves them; `quick`: by axis, on the grid's vertices, and on both of the
            network's maps, for less work a step. Not in the repr, which names checkpoints: the recipe's name
            is.
    """

    l1: float = 0.6
    dssim: float = 0.4
    l2: float = 0.0
    matte: float = 0.1
    position: float = 1e-3
    position_limit: float = 2.0
    scale: float = 1.0
    scale_limit: float = 1.0
    laplacian: float = 1.0
    deformation: float = 0.4
    rotation: float = 0.005
    pose: float = 1.0
    measures: Literal["quick", "released"] = field(default="quick", repr=False)


@dataclass(frozen=True)
class Perceptual:
    """A second opinion on the pixels, whose share of the photometric loss rises linearly (fact 33).

    Args:
        kind: `lpips` (cap4d.perceptual), `gradient` (`gradient_distance`), or `none`.
        weight: Factor of the distance, beside its share.
        most: Share that it has at last; the mixture of L1 and SSIM has the rest.
        start, stop: Steps from and to which the share rises.
        image_range: `fixed`: LPIPS sees images in [-1, 1]; `compat`: in [0, 1], as the released code has it.
    """

    kind: Literal["none", "lpips", "gradient"] = "none"
    weight: float = 0.0
    most: float = 0.0
    start: int = 0
    stop: int = 0
    image_range: Literal["fixed", "compat"] = "fixed"

    @staticmethod
    def of(kind: str, start: int, stop: int) -> Perceptual:
        """The usual weights of each kind."""
        weight, most = {"none": (0.0, 0.0), "lpips": (0.1, 0.9), "gradient": (1.0, 0.5)}[kind]
        return Perceptual(kind, weight, most, start, stop)

    def share(self, step: int) -> float:
        """In [0, most]."""
        if step <= self.start or self.kind == "none":
            return 0.0
        return self.most * min(1.0, (step - self.start) / max(1, self.stop - self.start))


Distance = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""What compares a rendered with a real [H, W, 3] image in [0, 1]."""


def gradient_distance(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean L1 distance of the horizontal and vertical differences of two images, summed over three scales.

    A stand-in for LPIPS that needs no weights: like it, it minds blurred or missing edges more than a change
    of tone. It knows nothing of what people see. (Gradient difference loss of Mathieu et al. 2016, eq. 6,
    with signs, on full, half and quarter size.)
    """
    x, total = (image - target).permute(2, 0, 1)[None], image.new_zeros(())
    for scale in range(3):
        x = F.avg_pool2d(x, 2) if scale else x
        total = total + x.diff(dim=-1).abs().mean() + x.diff(dim=-2).abs().mean()
    return total


def photometric(image: torch.Tensor, target: torch.Tensor, weights: LossWeights) -> torch.Tensor:
    """0.6 L1 + 0.4 (1 - SSIM) of two [H, W, 3] images in [0, 1] (fact 33 without its LPIPS).

    And as much of their mean squared error as the weights say.
    """
    if image.device.type == "cpu" and image.dtype == target.dtype == torch.float32:
        absolute, similar = l1_and_ssim(image, target)
    else:
        absolute, similar = (image - target).abs().mean(), ssim_map(image, target).mean()
    loss = weights.l1 * absolute + weights.dssim * (1 - similar)
    return loss if weights.l2 == 0 else loss + weights.l2 * (image - target).square().mean()


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Structural similarity of every pixel and channel, zero-padded as the splatting codes train with it.

    Wang et al. 2004, eq. 13, with an 11x11 Gaussian window of sigma 1.5.
    Args:
        image, target: [H, W, C] in [0, 1].
    Returns:
        [H, W, C] in [-1, 1].
    """
    channels = image.shape[-1]
    moments = torch.cat([image, target, image * image, target * target, image * target], -1)
    mean_x, mean_y, xx, yy, xy = gaussian_blur(moments).split(channels, -1)
    var_x, var_y, cov = xx - mean_x * mean_x, yy - mean_y * mean_y, xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    structure = (2 * cov + SSIM_C2) / (var_x + var_y + SSIM_C2)
    return luminance * structure


class _Blur(torch.autograd.Function):
    """A zero-padded blur with a symmetric window is its own adjoint: backward is the same blur."""

    @staticmethod
    def forward(ctx, image):
        return _blur(image)

    @staticmethod
    def backward(ctx, v_image):
        return _blur(v_image)


def gaussian_blur(image: torch.Tensor) -> torch.Tensor:
    """[H, W, C] -> [H, W, C]: SSIM's window applied to every channel, zero beyond the border."""
    return _Blur.apply(image)


def ssim_window(dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """[11] the Gaussian window along one axis; sums to 1."""
    x = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    window = torch.exp(-(x * x) / (2 * SSIM_SIGMA**2))
    return (window / window.sum()).to(dtype)


def _blur(image: torch.Tensor) -> torch.Tensor:
    channels = image.shape[-1]
    padded = F.pad(image, (0, -channels % BLUR_LANES)) if image.device.type == "cpu" else image
    lanes = padded.shape[-1]
    window = ssim_window(image.dtype).to(image.device)
    half = SSIM_WINDOW // 2
    x = padded.permute(2, 0, 1)[None]  # NCHW seen, NHWC in memory
    x = F.conv2d(x, window.view(1, 1, 1, -1).expand(lanes, -1, -1, -1), padding=(0, half), groups=lanes)
    x = F.conv2d(x, window.view(1, 1, -1, 1).expand(lanes, -1, -1, -1), padding=(half, 0), groups=lanes)
    return x[0].permute(1, 2, 0)[..., :channels]


def position_loss(means: torch.Tensor, visible: torch.Tensor, limit: float) -> torch.Tensor:
    """How far local means [N, 3] (face sizes) of visible Gaussians bool[N] stray beyond `limit` (fact 34)."""
    return _mean_over(F.relu(means.norm(dim=-1) - limit), visible)


def axis_position_loss(means: torch.Tensor, visible: torch.Tensor, limit: float) -> torch.Tensor:
    """The same along each axis, mean over the three."""
    return _mean_over(F.relu(means.abs() - limit).mean(-1), visible)


def scale_loss(log_scales: torch.Tensor, visible: torch.Tensor, limit: float) -> torch.Tensor:
    """Norm of what local scales [N, 3] of visible Gaussians bool[N] exceed `limit` by (fact 34)."""
    excess = F.relu(log_scales.exp() - limit)
    # A norm has no gradient at zero: the constant, far below any excess that matters, gives it one.
    return _mean_over((excess.square().sum(-1) + 1e-16).sqrt() - 1e-8, visible)


def laplacian_loss(deformation: torch.Tensor) -> torch.Tensor:
    """Mean over inner pixels of the squared Laplacian of maps [..., 3, S, S] over 0.0108 (fact 35)."""
    m = deformation / DEFORM_STD
    inner = m[..., 1:-1, 1:-1]
    around = m[..., :-2, 1:-1] + m[..., 2:, 1:-1] + m[..., 1:-1, :-2] + m[..., 1:-1, 2:]
    return (around - 4 * inner).square().sum(-3).mean()


def relative_deformation_loss(deformation: torch.Tensor, neutral: torch.Tensor) -> torch.Tensor:
    """Mean squared length of what the expression adds to [N, 3] m positions, over 0.0108 (fact 35)."""
    return ((deformation - neutral) / DEFORM_STD).square().sum(-1).mean()


def relative_rotation_loss(rotmats: torch.Tensor, neutral: torch.Tensor) -> torch.Tensor:
    """Mean squared angle from `neutral`'s to the triangle frames [M, 3, 3], rad^2 (fact 35).

    Of two rotations at an angle t, |R - R'|^2 = 8 sin^2(t / 2), which loses no digits where t is small.
    """
    sin2 = (rotmats - neutral).square().sum((-1, -2)) / 8
    sin = sin2.clamp(1e-12, 1 - 1e-6).sqrt()
    return (4 * sin2 * (torch.asin(sin) / sin).square()).mean()


def _mean_over(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean of values [N] where the mask holds; 0 when it holds nowhere."""
    mask = mask.to(values.dtype)
    return (values * mask).sum() / mask.sum().clamp(min=1)
