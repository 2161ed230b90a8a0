"""Pictures of the full avatar in float64: what an optimised one is compared with.

The rig, the binding and the splatting run in float64 (`raster.reference`); the network runs as its own
runtime runs it, in float32, 1e-6 of its answer off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cap4d.bind import bind, triangle_frames
from cap4d.bundle.bundle import Bundle
from cap4d.camera import opencv_from_rig
from cap4d.drive.clip import Frame
from cap4d.gaussians import SH_COUNTS
from cap4d.optimize.shots import Shot
from cap4d.player.tiers import choose_tier, moving_subject
from cap4d.raster.reference import rasterize_reference
from cap4d.raster.threads import one_torch_thread
from cap4d.track.progress import progress

LOCAL = ("means", "quats", "log_scales")


@dataclass(frozen=True, eq=False)
class Picture:
    """rgb float[H, W, 3], premultiplied, and alpha float[H, W]."""

    rgb: np.ndarray
    alpha: np.ndarray


@one_torch_thread()
def exact_pictures(bundle: Bundle, shots: Sequence[Shot], label: str) -> list[Picture]:
    """The float64 pictures of an avatar with its most exact deformer; 2 s each at 90,000 Gaussians.

    Args:
        label: For the progress lines.
    """
    oracle = _Oracle(bundle)
    return [oracle.picture(shot) for shot in progress(shots, label, len(shots))]


class _Oracle:
    """An avatar in float64."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        tier, self.network = choose_tier(bundle, bundle.tiers[0], threads=0, source="avatar")
        self.subject = moving_subject(bundle, tier).map(lambda a: np.ascontiguousarray(a, np.float64))
        self.local = {name: getattr(bundle, name).astype(np.float64) for name in LOCAL}
        self.opacities = 1 / (1 + np.exp(-bundle.opacity_logits.astype(np.float64)))
        self.sh = bundle.sh.astype(np.float64)

    def picture(self, shot: Shot) -> Picture:
        frames = triangle_frames(self.vertices(shot.frame), self.bundle.grid.faces)
        posed = bind(frames, **self.local, binding=self.bundle.binding)
        fields = (torch.from_numpy(np.ascontiguousarray(x)) for x in (*posed, self.opacities, self.sh))
        degree = SH_COUNTS[self.sh.shape[1]]
        with torch.no_grad():
            drawn = rasterize_reference(*fields, camera=shot.camera, background=None, sh_degree=degree)
        return Picture(drawn.rgb.numpy(), drawn.alpha.numpy())

    def vertices(self, frame: Frame) -> np.ndarray:
        """float64[G, 3] m, OpenCV axes (facts 20, 24)."""
        expr, still = frame.expr.astype(np.float64), np.zeros(len(frame.expr))
        eye_rot, neck_rot, jaw_rot = (
            getattr(frame, name).astype(np.float64) for name in ("eye_rot", "neck_rot", "jaw_rot")
        )
        posed = self.subject.pose(expr, eye_rot=eye_rot, neck_rot=neck_rot, jaw_rot=jaw_rot)
        deformation = self.bundle.deform_neutral
        if self.network is not None:
            straight = self.subject.pose(expr, eye_rot=eye_rot, jaw_rot=jaw_rot)
            moved = opencv_from_rig(straight - self.subject.pose(still, jaw_rot=jaw_rot))
            grid = self.bundle.grid
            answer = grid.from_map(self.network(np.ascontiguousarray(grid.to_map(moved), np.float32)))
            deformation = np.where(grid.deformable[:, None], answer, deformation)
        return opencv_from_rig(posed) + deformation
