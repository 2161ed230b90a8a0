"""A clip between its frames."""

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
    values = {}
    for name in ("expr", "eye_rot", "neck_rot", "jaw_rot", "rot", "tra"):
        value = getattr(clip, name)
        values[name] = None if value is None else between(value[here], value[there], blend, cut=name in TURNS)
    return Frame(t, clip.rig_name, **values)


def between(a: np.ndarray, b: np.ndarray, blend: float, *, cut: bool) -> np.ndarray:
    """Linear from `a` to `b`; with `cut`, a jump of more than `MAX_TURN` stays one."""
    if cut and np.linalg.norm(b - a) > MAX_TURN:
        return a if blend < 0.5 else b
    return (a + np.float32(blend) * (b - a)).astype(np.float32)
