"""How long and how finely an avatar is fitted: recipes, and in each the presets default, medium, low, debug.

`released` are the values of the released CAP4D code (facts 26-38), `paper` the paper's where it differs, and
`short` is for CPUs: docs/recipes.md has them side by side, every constant. A short schedule needs larger
steps: its learning rates are the released ones times what the shorter road asks for, decayed log-linearly as
there.
The Gaussians' floor, the split offset and some more can be chosen apart from the recipe, see `Choices`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from cap4d.avatar.losses import LossWeights, Perceptual
from cap4d.errors import ArgumentError

PRESET_NAMES = ("default", "medium", "low", "debug")
RECIPE_NAMES = ("released", "paper", "short")


@dataclass(frozen=True)
class LearningRates:
    """Adam's first and last learning rate of every parameter; log-linear in between (fact 36).

    Args:
        means: Local positions, face sizes.
        sh_dc, sh_rest: Colour coefficients.
        opacity, scale, rotation: Logits, log-scales, quaternions.
        deformer: The U-Net's weights.
        deformer_decay: Its L2 weight decay, added to the gradient.
        correction: Corrections of the tracked parameters, in units of their expected size, or neck offsets,
            rad.
        gaussian_eps, correction_eps: Adam's eps of both. 1e-15 is below any gradient, so that hidden
            Gaussians move at full rate by what is noise.
    """

    means: tuple[float, float] = (5e-3, 5e-5)
    sh_dc: tuple[float, float] = (2.5e-3, 2.5e-3)
    sh_rest: tuple[float, float] = (1.25e-4, 1.25e-4)
    opacity: tuple[float, float] = (0.025, 0.025)
    scale: tuple[float, float] = (5e-3, 5e-3)
    rotation: tuple[float, float] = (1e-3, 1e-3)
    deformer: tuple[float, float] = (1e-5, 1e-7)
    deformer_decay: float = 2e-3
    correction: tuple[float, float] = (1e-5, 1e-7)
    gaussian_eps: float = 1e-15
    correction_eps: float = 1e-18


@dataclass(frozen=True)
class Densify:
    """When and how Gaussians are cloned, split and pruned (facts 30, 37). Counts are optimisation steps.

    Args:
        start, stop, every: First and last step, and the period.
        gradient: Mean norm of dL/d(means2d) per view, px^-1, above which a Gaussian is refined.
        most: Gaussians the avatar may grow to, by as many in every round; None: the threshold alone decides.
        split_scale: World scale, m, above which a Gaussian is split instead of cloned.
        split_offset: Units of the deviation at which a split Gaussian's children are drawn: its local scale,
            or, as in the released code, its world scale, which leaves them where the parent was (fact 30).
        prune_opacity: Opacity below which a Gaussian goes.
        prune_least: Share of the Gaussians that goes in every round because the training views would miss it
            least; makes room for growth.
        prune_big_after: Step from which too large Gaussians go as well.
        prune_radius, prune_scale: Too large, px on a screen and m.
        reset_every: Period of lowering all opacities to at most 0.01, which also happens at `start`; 0:
            never.
        bounds: Whether Gaussians grow at `start` and `stop` themselves, and resets may fall on `stop`
            (`closed`), or not (`open`, as in the released code). Not in the repr, see `LossWeights`.
    """

    start: int
    stop: int
    every: int
    gradient: float = 1e-6
    most: int | None = 200_000
    split_scale: float = 0.01
    split_offset: Literal["local", "world"] = "local"
    prune_opacity: float = 0.005
    prune_least: float = 0.0
    prune_big_after: int = 20_000
    prune_radius: float = 20.0
    prune_scale: float = 0.1
    reset_every: int = 0
    bounds: Literal["closed", "open"] = field(default="closed", repr=False)

    def grows_at(self, step: int) -> bool:
        """Whether there is a round of growth after this step."""
        if step % self.every or not self.start <= step <= self.stop:
            return False
        return self.bounds == "closed" or step not in (self.start, self.stop)

    def resets_at(self, step: int) -> bool:
        """Whether opacities are lowered after this step (fact 37)."""
        last = self.stop if self.bounds == "closed" else self.stop - 1
        if not self.reset_every or step > last:
            return False
        return step == self.start or step % self.reset_every == 0


@dataclass(frozen=True)
class Preset:
    """Everything that shapes a fit but the data.

    Args:
        iterations: Optimisation steps, one view each.
        image_size: Longer side of the training images, px; larger ones are averaged down.
        grid_size: Side of the UV grid.
        deformer_width: First-layer channels of the U-Net (64 in the released system).
        gaussians, per_face: About how many at the start, in proportion to area, and at least how many per
            triangle. Pruning leaves a triangle one if this is at least 1.
        sh_degree, sh_every: Highest SH degree, and the steps between its increments from 0.
        corrections: What is learned about the tracked parameters: `tracked` corrects all of them (see
            `Corrections`), `neck` learns an offset a frame (fact 32), `none` trusts them; `auto` trusts
            captures of several cameras, which are calibrated, and corrects the others.
        rotation_every: Steps between those that pay for the triangles' turning, a slow and smooth term, at as
            much more weight.
        expression_noise: Standard deviation added to the expressions the network sees while it is fitted,
            so that it learns what an expression does, not what else happened in its frame; rig units.
        paint: Take the first colours from the images instead of grey (fact 29).
        checkpoint_every: Steps between checkpoints, unless they take so long that one is due before.
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
    recipe: str = "short"
    rates: LearningRates = field(default_factory=LearningRates)
    weights: LossWeights = field(default_factory=LossWeights)
    perceptual: Perceptual = field(default_factory=Perceptual)
    corrections: Literal["auto", "tracked", "neck", "none"] = "auto"
    rotation_every: int = 4
    expression_noise: float = 0.0
    grid_size: int = 128
    paint: bool = True
    checkpoint_every: int = 500


@dataclass(frozen=True)
class Choices:
    """What may be chosen apart from preset and recipe; None leaves it to them.

    What they were measured to be worth is in docs/recipes.md.

    Args:
        perceptual: `none`, `lpips`, or `gradient`, the stand-in without weights.
        lpips_range: `fixed` shows LPIPS images in [-1, 1], for which it was made; `compat` in [0, 1] as the
            released code (fact 33).
        split_offset: See `Densify`.
        per_face: See `Preset`. Without a floor, Gaussians may also grow larger than their triangle, to cover
            those that have none.
        prune: `opacity` takes out faint Gaussians alone, `contribution` those as well that the training views
            would miss least.
    """

    perceptual: str | None = None
    lpips_range: str | None = None
    split_offset: str | None = None
    per_face: int | None = None
    prune: str | None = None

    def applied(self, preset: Preset) -> Preset:
        """The preset with what was chosen."""
        densify = preset.densify
        if self.split_offset is not None:
            densify = replace(densify, split_offset=self.split_offset)
        if self.prune is not None:
            densify = replace(densify, prune_least=PRUNE_LEAST if self.prune == "contribution" else 0.0)
        per_face = preset.per_face if self.per_face is None else self.per_face
        weights = preset.weights
        if per_face == 0:
            weights = replace(weights, scale_limit=SPARSE_SCALE_LIMIT)
        chosen = {"densify": densify, "per_face": per_face, "weights": weights}
        return replace(preset, perceptual=self._perceptual(preset), **chosen)

    def _perceptual(self, preset: Preset) -> Perceptual:
        perceptual = preset.perceptual
        if self.perceptual is not None and self.perceptual != perceptual.kind:
            start, stop = round(0.1 * preset.iterations), round(0.6 * preset.iterations)
            ramp = (start, stop) if perceptual.kind == "none" else (perceptual.start, perceptual.stop)
            perceptual = Perceptual.of(self.perceptual, *ramp)
        return perceptual if self.lpips_range is None else replace(perceptual, image_range=self.lpips_range)


PRUNE_LEAST = 0.05
SPARSE_SCALE_LIMIT = 3.0

# released and paper ---------------------------------------------------------------------------------------


def _released(
    name: str,
    *,
    iterations: int,
    gaussians: int,
    densify: tuple[int, int, int],
    reset_every: int,
    lpips: tuple[int, int],
) -> Preset:
    """A row of fact 37's table; all the rest is common to its rows.

    Its limit of 20 px on a Gaussian's radius is not among them: the released code forgets the radii before it
    compares them.
    """
    start, stop, every = densify
    return Preset(
        name=name,
        recipe="released",
        iterations=iterations,
        image_size=512,
        deformer_width=64,
        gaussians=gaussians,
        per_face=2,
        sh_degree=3,
        sh_every=1000,
        densify=Densify(
            start=start,
            stop=stop,
            every=every,
            most=None,
            split_offset="world",
            prune_big_after=reset_every,
            prune_radius=math.inf,
            reset_every=reset_every,
            bounds="open",
        ),
        weights=LossWeights(matte=0.0, measures="released"),
        perceptual=Perceptual.of("lpips", *lpips),
        corrections="neck",
        rotation_every=1,
        paint=False,
        checkpoint_every=2_000,
    )


def _paper(released: Preset) -> Preset:
    """The paper's own values; where it gives none and builds on GaussianAvatars, that one's."""
    return replace(
        released,
        recipe="paper",
        densify=replace(released.densify, split_offset="local"),
        weights=replace(released.weights, l1=0.8, dssim=0.2, laplacian=0.0),
        perceptual=replace(released.perceptual, weight=1.0),
        corrections="none",
    )


RELEASED = {
    "default": _released(
        "default",
        iterations=100_000,
        gaussians=100_000,
        densify=(8_000, 70_000, 2_000),
        reset_every=20_000,
        lpips=(10_000, 60_000),
    ),
    "medium": _released(
        "medium",
        iterations=50_000,
        gaussians=50_000,
        densify=(4_000, 40_000, 2_000),
        reset_every=10_000,
        lpips=(5_000, 40_000),
    ),
    "low": _released(
        "low",
        iterations=25_000,
        gaussians=25_000,
        densify=(2_000, 24_000, 1_000),
        reset_every=10_000,
        lpips=(4_000, 24_000),
    ),
    "debug": _released(
        "debug",
        iterations=1_000,
        gaussians=100_000,
        densify=(80, 700, 200),
        reset_every=200,
        lpips=(100, 600),
    ),
}
PAPER = {name: _paper(preset) for name, preset in RELEASED.items()}

# short ------------------------------------------------------------------------------------------------------

SHORT_RATES = LearningRates(
    means=(2e-2, 1e-3),
    sh_dc=(4e-2, 2e-3),
    sh_rest=(2e-3, 1e-4),
    opacity=(0.05, 0.01),
    scale=(3e-2, 3e-3),
    rotation=(1e-2, 1e-3),
    deformer=(3e-4, 1e-5),
    deformer_decay=0.0,
    correction=(0.02, 0.002),
    gaussian_eps=1e-8,  # visible Gaussians' gradients are 100 times larger
    correction_eps=1e-15,
)

# With time to settle, hidden Gaussians can be held stiller still, and show fewer stray colours where a video
# never looked: on a talking head at `low`, 1e-8 -> 1e-7 gives 30.16 -> 30.24 dB held out (its last tenth
# 28.48 -> 28.58).
LONGER_RATES = replace(SHORT_RATES, gaussian_eps=1e-7)

# A camera that sees a head turn by a few degrees says little about depth: Gaussians stay near the surface,
# so that hair does not swim where the head goes on to turn (+0.1 dB on frames beyond the last trained one).
# A short fit has far to go, and squared errors show it where to begin: on a talking head's held-out frames,
# 800 steps, 28.66 -> 29.04 dB and SSIM 0.922 -> 0.925.
SHORT_WEIGHTS = LossWeights(l2=5.0, position=1e-2, position_limit=0.7)

PRESETS = {
    "default": Preset(
        name="default",
        iterations=10_000,
        image_size=512,
        deformer_width=64,
        gaussians=100_000,
        per_face=1,
        sh_degree=2,
        sh_every=2_500,
        expression_noise=0.1,
        densify=Densify(start=800, stop=7_200, every=200, most=180_000, split_scale=0.003),
        rates=LONGER_RATES,
        weights=SHORT_WEIGHTS,
    ),
    "medium": Preset(
        name="medium",
        iterations=5_000,
        image_size=384,
        deformer_width=32,
        gaussians=60_000,
        per_face=1,
        sh_degree=1,
        sh_every=1_600,
        expression_noise=0.1,
        densify=Densify(start=400, stop=3_600, every=100, most=120_000, split_scale=0.003),
        rates=LONGER_RATES,
        weights=SHORT_WEIGHTS,
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
        rates=LONGER_RATES,
        weights=SHORT_WEIGHTS,
    ),
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
        weights=SHORT_WEIGHTS,
    ),
}
RECIPES = {"released": RELEASED, "paper": PAPER, "short": PRESETS}


def preset_named(name: str, recipe: str = "short") -> Preset:
    """
    Raises:
        ArgumentError: There is no such preset or recipe.
    """
    if recipe not in RECIPES:
        raise ArgumentError(f"recipe: expected one of {', '.join(RECIPES)}, got {recipe!r}")
    if name not in RECIPES[recipe]:
        raise ArgumentError(f"preset: expected one of {', '.join(RECIPES[recipe])}, got {name!r}")
    return RECIPES[recipe][name]
