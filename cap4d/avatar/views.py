"""The images an avatar is fitted to, at the preset's size, and which of them are held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from cap4d.camera import Camera
from cap4d.capture.capture import Capture, View
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.flame import RELEASED_RIG
from cap4d.rig.head import HeadRig

HOLD_OUT_EVERY = 10  # of a video every tenth frame and the last tenth are never trained on
SHORTEST_VIDEO = 20  # frames
MOST_STILLS_HELD_OUT = 10  # fact 38


@dataclass(frozen=True, eq=False)
class FitView:
    """One image with all that is known about it.

    Args:
        capture: Index of the capture it comes from.
        frame: Its time step there.
        camera: Head-fixed, at the fitted size.
        pixels: float16[H, W, 3] in [0, 1], on white.
        coverage: float16[H, W] the person's matte, or None.
    """

    capture: int
    frame: int
    camera: Camera
    pixels: torch.Tensor
    coverage: torch.Tensor | None

    @property
    def target(self) -> torch.Tensor:
        """float32[H, W, 3]."""
        return self.pixels.float()

    def to(self, device: torch.device) -> FitView:
        """The same with its images on a device."""
        coverage = None if self.coverage is None else self.coverage.to(device)
        return replace(self, pixels=self.pixels.to(device), coverage=coverage)


@dataclass(frozen=True, eq=False)
class Split:
    """Training views and held-out views; `tail` marks held-out ones with no training frame after them."""

    train: tuple[FitView, ...]
    held_out: tuple[FitView, ...]
    tail: np.ndarray


def load_views(captures: Sequence[Capture], image_size: int) -> list[list[FitView]]:
    """Every image of every capture, averaged down to at most `image_size` px."""
    return [
        [_load_view(c, capture, view, image_size) for view in capture.views]
        for c, capture in enumerate(captures)
    ]


def _load_view(index: int, capture: Capture, view: View, image_size: int) -> FitView:
    camera = capture.head_camera(view)
    scale = min(1.0, image_size / max(camera.width, camera.height))
    width, height = (max(1, round(side * scale)) for side in (camera.width, camera.height))
    pixels = shrink(capture.image(view), width, height)
    matte = capture.matte(view)
    coverage = None if matte is None else shrink(matte[..., None], width, height)[..., 0].half()
    return FitView(index, view.frame, camera.resized(width, height), pixels.half(), coverage)


def shrink(image: np.ndarray, width: int, height: int) -> torch.Tensor:
    """[H, W, C] -> float32[height, width, C], every new pixel the mean of what it covers."""
    planes = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
    return F.interpolate(planes, size=(height, width), mode="area")[0].permute(1, 2, 0).contiguous()


def split_views(captures: Sequence[Capture], views: Sequence[list[FitView]]) -> Split:
    """Holds out what the captures mark, else the usual share of each (see `held_out_frames`)."""
    train, held_out, tail = [], [], []
    for capture, its_views in zip(captures, views, strict=True):
        marks = held_out_frames(capture)
        last = max((v.frame for v in its_views if not marks[v.frame]), default=-1)
        train += [v for v in its_views if not marks[v.frame]]
        held_out += [v for v in its_views if marks[v.frame]]
        tail += [v.frame > last for v in its_views if marks[v.frame]]
    if not train:
        raise ArgumentError("captures: expected a frame that is not held out, found none")
    return Split(tuple(train), tuple(held_out), np.array(tail, bool))


def held_out_frames(capture: Capture) -> np.ndarray:
    """bool[T] the frames of a capture that are never trained on.

    What the capture itself marks; else of a video (one camera, consecutive frames) every tenth frame and the
    last tenth; else the last tenth of the frames, at most ten (fact 38), and nothing of fewer than four.
    """
    frames = len(capture)
    if capture.held_out is not None:
        return capture.held_out
    marks = np.zeros(frames, bool)
    if is_video(capture):
        marks[HOLD_OUT_EVERY - 1 :: HOLD_OUT_EVERY] = True
        marks[frames - frames // HOLD_OUT_EVERY :] = True
    elif frames >= 4:
        marks[frames - min(MOST_STILLS_HELD_OUT, max(1, frames // 10)) :] = True
    return marks


def is_video(capture: Capture) -> bool:
    """Whether consecutive frames are moments apart, rather than unrelated stills or generated views."""
    return len(capture.cameras) == 1 and len(capture) >= SHORTEST_VIDEO


def spread(views: Sequence[FitView], count: int) -> list[FitView]:
    """At most `count` of the views, evenly over their order."""
    picked = np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)
    return [views[i] for i in picked]


def check_rig(capture: Capture, rig: HeadRig) -> None:
    """
    Raises:
        DataError: The capture's parameters belong to another rig, or do not fit this one.
    """
    source = capture.path / "fit.npz"
    name = capture.rig_name or RELEASED_RIG
    if name != rig.name:
        raise DataError(source, "rig_name", expected=rig.name, found=name)
    if capture.expr.shape[1] != rig.n_expressions:
        raise DataError(
            source, "expr", expected=f"float32[T, {rig.n_expressions}]", found=list(capture.expr.shape)
        )
