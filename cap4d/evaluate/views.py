"""Which images of a capture an avatar is measured on."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import groupby

import numpy as np

from cap4d.camera import Camera
from cap4d.capture.capture import Capture, View
from cap4d.errors import ArgumentError


def chosen_views(capture: Capture, wanted: Sequence[tuple[str, int]] | None) -> list[View]:
    """The views of these cameras and frames (None: all), one camera after the other, frames in order.

    Raises:
        ArgumentError: There is no such view, or none was asked for.
    """
    known = {(view.camera, view.frame): view for view in capture.views}
    pairs = list(known if wanted is None else dict.fromkeys((c, int(f)) for c, f in wanted))
    missing = [pair for pair in pairs if pair not in known]
    if missing:
        camera, frame = missing[0]
        expected = f"views of {capture.path}"
        raise ArgumentError(f"views: expected {expected}, got {camera} frame {frame}, which has none")
    if not pairs:
        raise ArgumentError(f"views: expected at least one of {capture.path}, got none")
    cameras = list(capture.cameras)
    return [known[pair] for pair in sorted(pairs, key=lambda pair: (cameras.index(pair[0]), pair[1]))]


def runs(views: Sequence[View], frames: Sequence[Camera]) -> list[range]:
    """Places in `views` of what follows each other: one camera, one size, frame after frame."""
    keys = [
        (view.camera, view.frame - i, camera.width, camera.height)
        for i, (view, camera) in enumerate(zip(views, frames, strict=True))
    ]
    groups = (list(group) for _, group in groupby(range(len(views)), key=lambda i: keys[i]))
    return [range(group[0], group[-1] + 1) for group in groups]


def select_views(
    capture: Capture,
    *,
    cameras: Collection[str] | None = None,
    frames: slice | None = None,
    held_out: bool = False,
) -> list[tuple[str, int]]:
    """(camera, frame) of the capture's views of these cameras and frames.

    Args:
        frames: As of a Python slice, of frame numbers.
        held_out: Only the frames that a fit holds out: those the capture marks, else the usual share.
    Raises:
        ArgumentError: An unknown camera, or no view is left.
    """
    unknown = [name for name in cameras or () if name not in capture.cameras]
    if unknown:
        raise ArgumentError(f"cameras: expected some of {', '.join(capture.cameras)}, got {unknown[0]}")
    kept = np.zeros(len(capture), bool)
    kept[slice(None) if frames is None else frames] = True
    if held_out:
        from cap4d.avatar.views import held_out_frames

        kept &= held_out_frames(capture)
    picked = [
        (view.camera, view.frame)
        for view in capture.views
        if kept[view.frame] and (cameras is None or view.camera in cameras)
    ]
    if not picked:
        raise ArgumentError(f"views: expected a view of {capture.path} that was asked for, found none")
    return picked


def parse_frames(text: str) -> slice:
    """`0:100:2` -> slice(0, 100, 2); a single number is one frame.

    Raises:
        ArgumentError: It is neither.
    """
    parts = text.split(":")
    try:
        numbers = [int(part) if part else None for part in parts]
    except ValueError:
        numbers = []
    if len(parts) == 1 and numbers and numbers[0] is not None and numbers[0] >= 0:
        return slice(numbers[0], numbers[0] + 1)
    step = numbers[2] if len(numbers) == 3 else None
    if not 2 <= len(numbers) <= 3 or (step is not None and step < 1):
        raise ArgumentError(f"frames: expected FIRST:END or FIRST:END:STEP, got {text}")
    return slice(*numbers)


def sized_camera(camera: Camera, size: int | None) -> Camera:
    """The camera at a larger side of at most `size` px; None leaves it."""
    scale = 1.0 if size is None else min(1.0, size / max(camera.width, camera.height))
    if scale == 1.0:
        return camera
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
