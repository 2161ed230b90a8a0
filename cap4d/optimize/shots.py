"""What an optimised avatar is looked at by: frames of its idle clip and of its capture, and cameras around
it.

Three sets that share no frame while there are enough: one that steps learn from, one that the error is
measured on, and expressions that the clip does not show, which are drawn only to be reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.camera import Camera
from cap4d.capture.capture import Capture
from cap4d.drive.clip import Frame
from cap4d.player.avatar import Avatar
from cap4d.player.offline import head_centre
from cap4d.rotation import axis_angle_to_rotmat

MAX_SIDE = 512  # px
LEARNED, MEASURED, BEYOND = 24, 16, 8  # shots of the idle clip, and of a capture; shots beyond them
AROUND_DEG = ((15, 0), (-15, 0), (0, 8), (0, -8), (30, 5), (-30, 5), (20, -8), (-20, -8))
"""Yaw and pitch of the views beside the default one, which every other shot is of."""
SEED = 0


@dataclass(frozen=True, eq=False)
class Shot:
    """A moment and a camera, head-fixed world."""

    frame: Frame
    camera: Camera


@dataclass(frozen=True, eq=False)
class Shots:
    """The three sets."""

    learned: tuple[Shot, ...]
    measured: tuple[Shot, ...]
    beyond: tuple[Shot, ...]


def choose_shots(avatar: Avatar, capture: Capture | None = None) -> Shots:
    """The shots of an avatar.

    Args:
        capture: Its training views are looked at too.
    Raises:
        ArgumentError: The capture's expressions are another rig's.
    """
    camera, centre = shrunk(avatar.camera), head_centre(avatar)
    cameras = [view for degrees in AROUND_DEG for view in (camera, turned(camera, centre, *degrees))]
    sets = {
        name: tuple(
            Shot(avatar.idle.frame(t), cameras[i % len(cameras)])
            for i, t in enumerate(_spread(len(avatar.idle), count, shift))
        )
        for name, count, shift in (("learned", LEARNED, 0.0), ("measured", MEASURED, 0.5))
    }
    if capture is not None:
        learned, measured = _captured(avatar, capture)
        sets = {"learned": sets["learned"] + learned, "measured": sets["measured"] + measured}
    beyond = [Shot(frame, cameras[i]) for i, frame in enumerate(_expressions(avatar.bundle))]
    return Shots(**sets, beyond=tuple(beyond))


def shrunk(camera: Camera) -> Camera:
    """The same view of at most `MAX_SIDE` px a side."""
    scale = min(1.0, MAX_SIDE / max(camera.width, camera.height))
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def turned(camera: Camera, centre: np.ndarray, yaw_deg: float, pitch_deg: float) -> Camera:
    """The camera carried around `centre` (OpenCV axes), still looking at it as it did."""
    yaw, pitch = (axis_angle_to_rotmat(np.radians(v)) for v in ([0.0, -yaw_deg, 0], [-pitch_deg, 0.0, 0]))
    turn = np.eye(4)
    turn[:3, :3] = yaw @ pitch
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    return replace(camera, viewmat=camera.viewmat @ np.linalg.inv(turn))


def _captured(avatar: Avatar, capture: Capture) -> tuple[tuple[Shot, ...], tuple[Shot, ...]]:
    """Training views to learn from and others to measure on."""
    from cap4d.avatar.views import held_out_frames

    clip, held_out = capture.clip(), held_out_frames(capture)
    avatar.check_rig(clip.rig_name)
    views = [view for view in capture.views if not held_out[view.frame]]

    def shots(count: int, shift: float) -> tuple[Shot, ...]:
        chosen = (views[i] for i in _spread(len(views), min(count, len(views)), shift))
        return tuple(Shot(clip.frame(v.frame), shrunk(capture.head_camera(v))) for v in chosen)

    return shots(LEARNED, 0.0), shots(MEASURED, 0.5)


def _expressions(bundle: Bundle) -> Sequence[Frame]:
    """Faces of several expressions at once, each somewhere in its range."""
    rng = np.random.default_rng(SEED)
    low, high = bundle.expression_range.T
    zeros = np.zeros(3, np.float32)
    frames = []
    for t in range(BEYOND):
        active = rng.random(bundle.n_expressions) < 4 / bundle.n_expressions
        expr = np.where(active, rng.uniform(low, high), 0).astype(np.float32)
        frames.append(Frame(float(t), bundle.rig_name, expr, zeros, zeros, zeros))
    return frames


def _spread(length: int, count: int, shift: float) -> np.ndarray:
    """int64[count] indices, evenly over a length; a shift of 0.5 falls between those of 0."""
    return ((np.arange(count) + shift) * length / count).astype(np.int64)
