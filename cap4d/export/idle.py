"""What an avatar does when nothing drives it: a few seconds of its own capture, or a calm face that
blinks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.drive.clip import Clip

LONGEST, SHORTEST = 8.0, 1.5  # s
SEAM = 0.5  # s over which the end of the clip turns into its beginning
STILL_SECONDS, STILL_FPS = 6.0, 30.0
BLINKS = (1.2, 4.1)  # s
BLINK_SECONDS = 0.3
BLINK_NAMES = ("eyeBlinkLeft", "eyeBlinkRight", "eyeBlink_L", "eyeBlink_R", "blink")
FIELDS = ("expr", "eye_rot", "neck_rot", "jaw_rot", "rot", "tra")


def idle_clip(clip: Clip, expression_names: tuple[str, ...]) -> Clip:
    """A clip that can repeat: from the capture's own where that is a film, else a still of its calmest
    frame.
    """
    if clip.duration >= SHORTEST and is_film(clip):
        return looped(clip)
    return still(clip, int(np.abs(clip.expr).sum(1).argmin()), expression_names)


def is_film(clip: Clip) -> bool:
    """Whether its frames follow each other in time: then a frame resembles the next one more than any
    other.
    """
    spread = np.abs(clip.expr - clip.expr.mean(0)).sum()
    return float(np.abs(np.diff(clip.expr, axis=0)).sum()) < 0.5 * spread


def looped(clip: Clip) -> Clip:
    """The clip's first seconds without its first half second, into which the end is blended instead.

    So the last frame precedes the first one. Rotations within a clip differ little and are blended as
    vectors.
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


def still(clip: Clip, frame: int, expression_names: tuple[str, ...]) -> Clip:
    """One frame of the clip held for six seconds, with two blinks where the rig can blink."""
    frames = round(STILL_SECONDS * STILL_FPS)
    held = {
        name: None if (v := getattr(clip, name)) is None else np.repeat(v[frame : frame + 1], frames, 0)
        for name in FIELDS
    }
    lids = [i for i, name in enumerate(expression_names) if name in BLINK_NAMES]
    time = np.arange(frames) / STILL_FPS
    closed = sum(
        np.maximum(0, np.cos(np.pi * np.clip((time - t) / BLINK_SECONDS, -0.5, 0.5))) for t in BLINKS
    )
    expr = held["expr"].astype(np.float32)
    expr[:, lids] = np.maximum(expr[:, lids], closed[:, None])
    return replace(clip, fps=STILL_FPS, **(held | {"expr": expr}))
