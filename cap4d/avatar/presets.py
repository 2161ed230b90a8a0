"""How long and how finely an avatar is fitted: `debug` takes about a minute, `low` is for CPUs.

The released system's schedules (fact 37) run 25k to 100k steps on a GPU. A short schedule needs larger steps:
learning rates here are the released ones (fact 36) times what the shorter road asks for, decayed log-linearly
as there. Other differences from the released system, each for a short fit on a CPU: narrower networks without
weight decay (fact 36), Adam's eps of 1e-8 for Gaussians (fact 36: 1e-15), growth by the largest gradients up
to a given number instead of by a threshold alone, no opacity resets (fact 37), a matte term, and at least one
Gaussian a triangle (fact 29: two).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from cap4d.avatar.losses import LossWeights
from cap4d.errors import ArgumentError


@dataclass(frozen=True)
class LearningRates:
    """Adam's first and last learning rate of every parameter; log-linear in between (fact 36).

    Args:
        means: Local positions, face sizes.
        sh_dc, sh_rest: Colour coefficients.
        opacity, scale, rotation: Logits, log-scales, quaternions.
        deformer: The U-Net's weights.
        deformer_decay: Its L2 weight decay, added to the gradient.
        correction: Corrections of the tracked parameters, in units of their expected size.
    """

    means: tuple[float, float] = (5e-3, 5e-5)
    sh_dc: tuple[float, float] = (2.5e-3, 2.5e-3)
    sh_rest: tuple[float, float] = (1.25e-4, 1.25e-4)
    opacity: tuple[float, float] = (0.025, 0.025)
    scale: tuple[float, float] = (5e-3, 5e-3)
    rotation: tuple[float, float] = (1e-3, 1e-3)
    deformer: tuple[float, float] = (1e-5, 1e-7)
    deformer_decay: float = 2e-3
    correction: tuple[float, float] = (0.02, 0.002)


@dataclass(frozen=True)
class Densify:
    """When and how Gaussians are cloned, split and pruned (facts 30, 37). Counts are optimisation steps.

    Args:
        start, stop, every: First and last step, and the period.
        gradient: Mean norm of dL/d(means2d) per view, px^-1, above which a Gaussian is refined.
        most: Gaussians the avatar may grow to, by as many in every round.
        split_scale: World scale, m, above which a Gaussian is split instead of cloned.
        prune_opacity: Opacity below which a Gaussian goes.
        prune_big_after: Step from which too large Gaussians go as well.
        reset_every: Period of lowering all opacities to at most 0.01; 0: never.
    """

    start: int
    stop: int
    every: int
    gradient: float = 1e-6
    most: int = 200_000
    split_scale: float = 0.01
    prune_opacity: float = 0.005
    prune_big_after: int = 20_000
    prune_radius: float = 20.0
    prune_scale: float = 0.1
    reset_every: int = 0


@dataclass(frozen=True)
class Preset:
    """Everything that shapes a fit but the data.

    Args:
        iterations: Optimisation steps, one view each.
        image_size: Longer side of the training images, px; larger ones are averaged down.
        grid_size: Side of the UV grid.
        deformer_width: First-layer channels of the U-Net (64 in the released system).
        gaussians, per_face: About how many at the start, in proportion to area, and at least how many per
            triangle.
        sh_degree, sh_every: Highest SH degree, and the steps between its increments from 0.
        expression_noise: Standard deviation added to the expressions the network sees while it is fitted,
            so that it learns what an expression does, not what else happened in its frame; rig units.
        paint: Take the first colours from the images instead of grey (fact 29).
        checkpoint_every: Steps between checkpoints.
    """

    name: str
    iterations: int
    image_size: int
    deformer_width: int
    gaussians: int
    per_face: int
    sh_degree: int
    sh_every: int
    densify: Densify
    rates: LearningRates = field(default_factory=LearningRates)
    weights: LossWeights = field(default_factory=LossWeights)
    expression_noise: float = 0.0
    grid_size: int = 128
    paint: bool = True
    checkpoint_every: int = 500


SHORT_RATES = LearningRates(
    means=(2e-2, 1e-3),
    sh_dc=(4e-2, 2e-3),
    sh_rest=(2e-3, 1e-4),
    opacity=(0.05, 0.01),
    scale=(3e-2, 3e-3),
    rotation=(1e-2, 1e-3),
    deformer=(3e-4, 1e-5),
    deformer_decay=0.0,
)

# A camera that sees a head turn by a few degrees says little about depth: Gaussians stay near the surface,
# so that hair does not swim where the head goes on to turn (+0.1 dB on frames beyond the last trained one).
NEAR_SURFACE = LossWeights(position=1e-2, position_limit=0.7)

PRESETS = {
    "debug": Preset(
        name="debug",
        iterations=500,
        image_size=256,
        deformer_width=16,
        gaussians=30_000,
        per_face=1,
        sh_degree=0,
        sh_every=1000,
        densify=Densify(start=100, stop=400, every=50, most=50_000, split_scale=0.003),
        rates=SHORT_RATES,
        weights=NEAR_SURFACE,
    ),
    "low": Preset(
        name="low",
        iterations=2_500,
        image_size=256,
        deformer_width=16,
        gaussians=40_000,
        per_face=1,
        sh_degree=1,
        sh_every=800,
        expression_noise=0.1,
        densify=Densify(start=200, stop=1_800, every=100, most=90_000, split_scale=0.003),
        rates=SHORT_RATES,
        weights=NEAR_SURFACE,
    ),
}


def preset_named(name: str) -> Preset:
    """
    Raises:
        ArgumentError: There is no such preset.
    """
    if name not in PRESETS:
        raise ArgumentError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]
