"""What a made-up person looks like, as a handful of numbers drawn from a seed: skin, hair, eyes, clothes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Linear RGB of skin without pigment, and what one unit of each pigment takes away (natural logarithm): fitted
# by eye to photographs of fair to very dark skin.
SKIN_BASE = np.array([0.84, 0.72, 0.59])
MELANIN = np.array([0.46, 0.80, 1.08])
HAEMOGLOBIN = np.array([0.05, 0.42, 0.34])

# Linear RGB.
IRIS_COLORS = np.array(
    [[0.055, 0.022, 0.008], [0.13, 0.055, 0.018], [0.16, 0.115, 0.035], [0.11, 0.15, 0.085],
     [0.12, 0.20, 0.31], [0.20, 0.25, 0.29]]
)  # fmt: skip
CLOTH_COLORS = np.array(
    [[0.035, 0.05, 0.09], [0.25, 0.25, 0.26], [0.03, 0.03, 0.032], [0.16, 0.035, 0.035], [0.05, 0.11, 0.075],
     [0.55, 0.53, 0.49], [0.10, 0.13, 0.20], [0.22, 0.15, 0.085]]
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Complexion:
    """One person's colours and marks. Colours are linear RGB; amounts are 0 (none) to 1 (much).

    Args:
        melanin, haemoglobin: Amounts of the skin's two pigments.
        blush, freckles, moles, stubble, brow, lip: Amounts.
        hair, iris, iris_inner, cloth: [3].
        lip_tint: [3] what the lips' colour is multiplied by.
        scalp: [V] how densely hair grows, or None before it is grown.
        seed: Of all that is strewn over the skin.
    """

    melanin: float
    haemoglobin: float
    blush: float
    freckles: float
    moles: float
    stubble: float
    brow: float
    lip: float
    hair: np.ndarray
    iris: np.ndarray
    iris_inner: np.ndarray
    cloth: np.ndarray
    lip_tint: np.ndarray
    seed: int
    scalp: np.ndarray | None = None

    def skin(self, melanin: np.ndarray, haemoglobin: np.ndarray) -> np.ndarray:
        """[N] and [N] amounts of pigment -> [N, 3] linear albedo."""
        taken = melanin[:, None] * MELANIN + haemoglobin[:, None] * HAEMOGLOBIN
        return SKIN_BASE * np.exp(-taken)


def draw_complexion(rng: np.random.Generator, hair: np.ndarray) -> Complexion:
    """A plausible person: dark eyes go with dark skin and dark hair, freckles with fair.

    Args:
        hair: [3] its colour, linear RGB.
    """
    light_hair = float(np.clip((hair.mean() - 0.03) / 0.1, 0, 1))
    melanin = float(0.22 + (1.9 - 1.3 * light_hair) * rng.beta(1.1, 1.9))
    fair = np.clip((0.75 - melanin) / 0.5, 0, 1)
    iris = _pick(rng, IRIS_COLORS, [0.2, 0.2, 0.15, 0.15, 0.2, 0.1], fair)
    bearded = rng.random() < 0.5
    return Complexion(
        melanin=melanin,
        haemoglobin=float(rng.uniform(0.45, 0.85)),
        blush=float(rng.uniform(0.25, 0.8)),
        freckles=float(fair * rng.choice([0.0, 0.15, 0.5, 1.0], p=[0.3, 0.3, 0.25, 0.15])),
        moles=float(rng.uniform(0.2, 1)),
        stubble=float(bearded * rng.choice([0.25, 0.5, 0.85])),
        brow=float(rng.uniform(0.7, 1.0)),
        lip=float(rng.uniform(0.35, 0.7) if bearded else rng.uniform(0.5, 1.0)),
        hair=hair,
        iris=iris * rng.uniform(0.8, 1.2),
        iris_inner=np.array([0.20, 0.095, 0.026]) * rng.uniform(0.5, 1.2),
        cloth=CLOTH_COLORS[rng.integers(len(CLOTH_COLORS))] * rng.uniform(0.7, 1.3),
        lip_tint=rng.uniform([0.9, 0.8, 0.85], [1.02, 1.0, 1.05]),
        seed=int(rng.integers(2**31)),
    )


def _pick(rng: np.random.Generator, colors: np.ndarray, shares: list[float], fair: float) -> np.ndarray:
    """One of the colours; on dark skin nearly always one of the first two."""
    dark = np.array([0.8, 0.2] + [0.0] * (len(colors) - 2))
    return colors[rng.choice(len(colors), p=fair * np.array(shares) + (1 - fair) * dark)]
