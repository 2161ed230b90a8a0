"""How far the pictures of a candidate are from those of the full avatar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cap4d.evaluate.image import psnr_of_mse
from cap4d.gaussians import Gaussians
from cap4d.optimize.oracle import Picture
from cap4d.optimize.shots import Shot
from cap4d.player.avatar import Avatar
from cap4d.render import render


@dataclass(frozen=True, eq=False)
class Error:
    """Squared errors of pictures, each the mean of those on black and on white.

    On white alone a white shirt could go, on black alone black hair.

    Args:
        mse: float64[K] mean over pixels and channels, of each shot.
        pixels: float64[K] of each shot.
    """

    mse: np.ndarray
    pixels: np.ndarray

    @property
    def pooled(self) -> float:
        """Mean squared error over all pixels of all shots."""
        return float((self.mse * self.pixels).sum() / self.pixels.sum())

    @property
    def psnr(self) -> float:
        """Of the pooled error, dB."""
        return psnr_of_mse(self.pooled)

    @property
    def worst(self) -> float:
        """PSNR of the worst shot, dB."""
        return psnr_of_mse(float(self.mse.max()))


def measure(avatar: Avatar, shots: Sequence[Shot], truth: Sequence[Picture]) -> Error:
    """Draws the shots as the player does and compares them with the truth."""
    errors = []
    for shot, exact in zip(shots, truth, strict=True):
        drawn = render(pose(avatar, shot), shot.camera, background=None, threads=avatar.threads)
        errors.append(_mse(drawn.rgb, drawn.alpha, exact))
    return Error(np.array(errors), np.array([float(t.alpha.size) for t in truth]))


def pose(avatar: Avatar, shot: Shot) -> Gaussians:
    """The Gaussians of a shot."""
    f = shot.frame
    return avatar.pose(f.expr, eye_rot=f.eye_rot, neck_rot=f.neck_rot, jaw_rot=f.jaw_rot)


def _mse(rgb: np.ndarray, alpha: np.ndarray, exact: Picture) -> float:
    on_black = rgb - exact.rgb
    on_white = on_black - (alpha - exact.alpha)[..., None]
    return float((np.square(on_black).mean() + np.square(on_white).mean()) / 2)
