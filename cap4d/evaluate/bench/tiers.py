"""The tiers of a deformer that an avatar has, each ready to play."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.reader import read_bundle
from cap4d.camera import opencv_from_rig
from cap4d.drive.clip import Frame
from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar

TIERS = ("full", "fp16", "int8", "linear", "off")
"""Most exact first; the first that an avatar has is what the others are compared with."""


def load_tiers(path: Path, *, threads: int) -> dict[str, Avatar]:
    """An avatar in each of its tiers, most exact first.

    Raises:
        DataError: The file is not sound.
    """
    bundle = read_bundle(path)
    found = {}
    for tier in TIERS:
        try:
            found[tier] = Avatar(bundle, deformer=tier, threads=threads, source=str(path))
        except ArgumentError:  # it does not have this one
            continue
    return found


def clip_frames(bundle: Bundle, count: int) -> list[Frame]:
    """`count` frames spread over the idle clip."""
    length = len(bundle.idle)
    return [bundle.idle.frame(int(i)) for i in np.linspace(0, length - 1, min(count, length))]


def offset_maps(bundle: Bundle, frames: list[Frame]) -> list[np.ndarray]:
    """What the deformer is given for each frame: float32[3, S, S] m, no two in a row alike."""
    neutral = bundle.subject.pose(np.zeros(bundle.n_expressions, np.float32))
    maps = []
    for frame in frames:
        straight = bundle.subject.pose(frame.expr.astype(np.float32), eye_rot=frame.eye_rot)
        offsets = bundle.grid.to_map(opencv_from_rig(straight - neutral))
        maps.append(np.ascontiguousarray(offsets, np.float32))
    return maps


def vertices_of(avatar: Avatar, frame: Frame) -> np.ndarray:
    """[G, 3] m of a frame."""
    return avatar.vertices(frame.expr, eye_rot=frame.eye_rot, neck_rot=frame.neck_rot, jaw_rot=frame.jaw_rot)
