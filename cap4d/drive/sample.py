"""Between frames: of a clip, and of any two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.drive.clip import Clip, Frame

MAX_TURN = 1.0  # rad between frames up to which axis-angles are interpolated as they are; beyond it is a cut

EPSILON = 1e-6  # frames
TURNS = ("eye_rot", "neck_rot", "jaw_rot", "rot")


def sample(clip: Clip, t: float) -> Frame:
    """The clip at `t` seconds, linear between frames; beyond its end it starts again.

    A jump of the head's pose or gaze by more than 1 rad from frame to frame is a cut and stays one.
    """
    position = t * clip.fps
    index = int(np.floor(position + EPSILON))  # a time that is a frame's, but for rounding, is that frame
    blend = position - index
    here, there = index % len(clip), min(index % len(clip) + 1, len(clip) - 1)
    if blend < EPSILON or here == there:
        return replace(clip.frame(index), t=t)
    return replace(mix(clip.frame(here), clip.frame(there), blend), t=t)


def mix(a: Frame, b: Frame, blend: float) -> Frame:
    """Linear from `a` (0) to `b` (1); a head pose that only one of them has is taken as it is."""
    values = {"expr": _between(a.expr, b.expr, blend, cut=False)}
    for name in (*TURNS, "tra"):
        x, y = getattr(a, name), getattr(b, name)
        values[name] = _between(x, y, blend, cut=name in TURNS) if x is not None and y is not None else y
    return replace(b, t=a.t + blend * (b.t - a.t), **values)


def _between(a: np.ndarray, b: np.ndarray, blend: float, *, cut: bool) -> np.ndarray:
    """Linear from `a` to `b`; with `cut`, a jump of more than `MAX_TURN` stays one."""
    if cut and np.linalg.norm(b - a) > MAX_TURN:
        return a if blend < 0.5 else b
    return (a + np.float32(blend) * (b - a)).astype(np.float32)
