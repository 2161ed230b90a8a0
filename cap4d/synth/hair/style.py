"""Hair styles and colours, drawn by lot from a seed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cap4d.errors import ArgumentError


@dataclass(frozen=True)
class HairStyle:
    """What a head of hair looks like; lengths in metres.

    Args:
        name: Of the style.
        count: Strands on the scalp.
        points: Of a strand.
        top, side: Length on top of the head, and at the sides and the nape.
        lift: How far the outermost strands stand off the scalp.
        sweep: [3] direction (rig axes) in which the hair on top is combed; its length is how strongly.
        part: x of a parting, or None.
        cut: Heights (eyes 0, top of the skull 1) at which long hair ends, or None.
        fringe: Height at which a fringe ends, or None.
        gravity: Pull downwards, against the other directions' 1.
        wave, wavelength: Radius and length of a curl.
        clump, clumps: How far strands lean to their tuft, and number of tufts.
        frizz: Displacement of a strand's tip.
        raised: How far a receding hairline lies higher, heights.
        crown: Share of the hair left on top.
    """

    name: str
    count: int = 16000
    points: int = 12
    top: float = 0.05
    side: float = 0.02
    lift: float = 0.012
    sweep: tuple[float, float, float] = (0.0, 0.0, 0.0)
    part: float | None = None
    cut: float | None = None
    fringe: float | None = None
    gravity: float = 0.25
    wave: float = 0.0
    wavelength: float = 0.05
    clump: float = 0.35
    clumps: int = 900
    frizz: float = 0.002
    raised: float = 0.0
    crown: float = 1.0


STYLES = {
    style.name: style
    for style in (
        HairStyle("bald", count=0),
        HairStyle("buzz", count=22000, points=6, top=0.007, side=0.004, lift=0.007, clump=0, frizz=0.001),
        HairStyle("crop", top=0.035, side=0.012, lift=0.013, sweep=(0, 0, 0.8)),
        HairStyle("quiff", top=0.055, side=0.013, lift=0.022, sweep=(0.3, 0.2, -1.0), clump=0.45),
        HairStyle("side-part", top=0.075, side=0.022, lift=0.014, part=0.03, sweep=(0, 0, -0.3), points=14),
        HairStyle("swept-back", top=0.10, side=0.05, lift=0.013, sweep=(0, 0, -1.5), points=14, gravity=0.2),
        HairStyle("fringe", top=0.09, side=0.06, lift=0.013, sweep=(0, 0, 0.6), fringe=0.27, points=14),
        HairStyle("bob", count=11000, top=0.2, side=0.2, lift=0.017, part=0.02, cut=-0.75, gravity=0.6),
        HairStyle("long", count=9000, top=0.3, side=0.3, lift=0.016, part=0.0, cut=-1.7, gravity=0.6),
        HairStyle(
            "curly", 14000, 22, 0.075, 0.04, 0.028, wave=0.008, wavelength=0.026, clump=0.8, clumps=420
        ),
        HairStyle("receding", top=0.03, side=0.015, lift=0.009, raised=0.20, crown=0.5, sweep=(0, 0, -0.4)),
        HairStyle("horseshoe", count=9000, top=0.012, side=0.014, lift=0.007, raised=0.1, crown=0.0),
    )
}
WEIGHTS = {
    "bald": 0.04,
    "buzz": 0.08,
    "crop": 0.15,
    "quiff": 0.11,
    "side-part": 0.14,
    "swept-back": 0.09,
    "fringe": 0.09,
    "bob": 0.09,
    "long": 0.06,
    "curly": 0.07,
    "receding": 0.05,
    "horseshoe": 0.03,
}
# sRGB of a lit strand, and how often it is met.
COLORS = {
    "black": ((0.12, 0.103, 0.098), 0.24),
    "dark brown": ((0.19, 0.135, 0.10), 0.26),
    "brown": ((0.30, 0.205, 0.14), 0.18),
    "light brown": ((0.39, 0.275, 0.18), 0.09),
    "dark blond": ((0.56, 0.42, 0.285), 0.07),
    "blond": ((0.78, 0.61, 0.42), 0.05),
    "red": ((0.44, 0.20, 0.095), 0.03),
    "grey": ((0.50, 0.49, 0.48), 0.04),
    "white": ((0.80, 0.79, 0.77), 0.02),
    "dyed": ((0.34, 0.20, 0.46), 0.02),
}


def draw_style(rng: np.random.Generator, name: str | None = None) -> HairStyle:
    """A style by lot, its measures varied a little; `name` chooses which one.

    Raises:
        ArgumentError: No such style.
    """
    drawn = str(rng.choice(list(WEIGHTS), p=np.array(list(WEIGHTS.values())) / sum(WEIGHTS.values())))
    if name is not None and name not in STYLES:
        raise ArgumentError(f"style: expected {', '.join(STYLES)}, got {name}")
    style = STYLES[name or drawn]
    scale, mirror = rng.uniform(0.85, 1.2, 3), rng.choice([-1.0, 1.0])
    wavy = style.wave == 0 and style.top > 0.08 and rng.random() < 0.5
    x, y, z = style.sweep
    return replace(
        style,
        top=style.top * scale[0],
        side=style.side * scale[1],
        lift=style.lift * scale[2],
        sweep=(x * mirror, y, z),
        part=None if style.part is None else style.part * mirror,
        wave=rng.uniform(0.002, 0.006) if wavy else style.wave,
        wavelength=rng.uniform(0.045, 0.08) if wavy else style.wavelength,
        clump=style.clump * rng.uniform(0.7, 1.4),
    )


def draw_color(rng: np.random.Generator) -> np.ndarray:
    """[3] sRGB of a head of hair, by lot."""
    share = np.array([s for _, s in COLORS.values()])
    base = np.array(list(COLORS.values())[rng.choice(len(share), p=share / share.sum())][0])
    return np.clip(base * rng.uniform(0.85, 1.15) * rng.uniform(0.95, 1.05, 3), 0, 1)
