"""What an avatar does when nothing drives it: some seconds of its own capture, or an invented performance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.drive.clip import Clip
from cap4d.rig.head import HeadRig
from cap4d.synth.idle import blinks, expression_vector
from cap4d.synth.idle import idle_clip as invented_clip

LONGEST, SHORTEST = 8.0, 1.5  # s
SHUT = 0.6  # mean of the lids' weights that counts as a blink
SEAM = 0.5  # s over which the end of the clip turns into its beginning
FIELDS = ("expr", "eye_rot", "neck_rot", "jaw_rot", "rot", "tra")


def idle_clip(clip: Clip, rig: HeadRig) -> Clip:
    """A clip that can repeat: from the capture's own where that is a film, else an invented one.

    A film in which nobody blinks (a short one, often) is given blinks: without them a face stares. The
    invented one keeps the head where the capture's calmest frame has it.
    """
    if clip.duration >= SHORTEST and is_film(clip):
        return blinking(looped(clip), rig)
    invented = invented_clip(rig)
    calm = int(np.abs(clip.expr).sum(1).argmin())
    held = {
        name: None if (value := getattr(clip, name)) is None else np.repeat(value[[calm]], len(invented), 0)
        for name in ("rot", "tra")
    }
    return replace(invented, **held)


def is_film(clip: Clip) -> bool:
    """Whether its frames follow each other in time: a frame then resembles the next more than any other."""
    spread = np.abs(clip.expr - clip.expr.mean(0)).sum()
    return float(np.abs(np.diff(clip.expr, axis=0)).sum()) < 0.5 * spread


def blinking(clip: Clip, rig: HeadRig, *, seed: int = 0) -> Clip:
    """The clip with invented blinks, where its rig has lids to close by name and they never come down."""
    lids = expression_vector(rig, {"eyeBlink": 1.0, "blink": 1.0})
    if not lids.any() or clip.expr[:, lids > 0].mean(1).max() > SHUT:
        return clip
    times = np.arange(len(clip)) / clip.fps
    shut = blinks(np.random.default_rng(seed), times, clip.duration).astype(np.float32)[:, None] * lids
    return replace(clip, expr=clip.expr * (1 - shut) + shut)


def looped(clip: Clip) -> Clip:
    """The clip's first seconds without its first half second, into which the end is blended instead.

    So the last frame precedes the first. Rotations within a clip differ little and are blended as vectors.
    """
    frames = min(len(clip), round(LONGEST * clip.fps))
    seam = min(round(SEAM * clip.fps), frames // 3)
    weights = (np.arange(1, seam + 1) / (seam + 1)).astype(np.float32)[:, None]

    def blend(values: np.ndarray | None) -> np.ndarray | None:
        if values is None:
            return None
        loop = values[seam:frames].astype(np.float32)
        loop[len(loop) - seam :] = values[frames - seam : frames] * (1 - weights) + values[:seam] * weights
        return loop

    return replace(clip, **{name: blend(getattr(clip, name)) for name in FIELDS})
