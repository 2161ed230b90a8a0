"""What a fit learns about the tracked parameters: corrections of all of them, neck offsets, or nothing.

A correction (`Corrections`) is a function of the tracked sequence, never of one image alone: a linear map of
the tracked parameters plus a residual that is smooth in time. Frames without a training image (held out, or
in between) therefore get the correction of their neighbours; their own image enters only through the tracker.
The released system's neck offsets (`NeckOffsets`) are a parameter a frame; those without an image have none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from cap4d.avatar.model import Pose
from cap4d.capture.capture import Capture
from cap4d.drive.clip import Clip
from cap4d.rotation import axis_angle_to_rotmat, rotmat_to_axis_angle

FADE_FRAMES = 3.0  # how far a residual reaches beyond the trained frames
KERNEL_FRAMES = 1.0  # standard deviation of the residual's smoothing, in frames
POSE_FIELDS = ("rot", "tra", "expr", "eye_rot", "neck_rot")
EXPECTED_SIZE = {"rot": 0.01, "tra": 2e-3, "expr": 0.05, "eye_rot": 0.03, "neck_rot": 0.03}
"""A unit of correction (rad, m, rig units, rad, rad), which penalties and learning rates are relative to."""


@dataclass(frozen=True, eq=False)
class Corrected:
    """A pose with its correction applied.

    Args:
        pose: Expression, eyes, neck and jaw.
        rigid: Rotation [3, 3] and translation [3] of the whole head in the head-fixed frame; None: none.
    """

    pose: Pose
    rigid: tuple[torch.Tensor, torch.Tensor] | None


class Uncorrected(nn.Module):
    """One capture's parameters as they were tracked."""

    def __init__(self, capture: Capture) -> None:
        super().__init__()
        for name in (*POSE_FIELDS, "jaw_rot"):
            value = torch.from_numpy(getattr(capture, name).copy())
            self.register_buffer(name, value, persistent=False)

    def at(self, frame: int) -> Corrected:
        """The parameters of a frame."""
        p = (self.expr, self.eye_rot, self.neck_rot, self.jaw_rot)
        return Corrected(Pose(*(x[frame] for x in p)), None)

    def penalty(self, frame: int) -> torch.Tensor:
        """0."""
        return self.expr.new_zeros(())

    def corrected(self, clip: Clip) -> Clip:
        """The clip itself."""
        return clip


class NeckOffsets(Uncorrected):
    """A small rotation of the neck in every frame, learned with it (fact 32).

    Like the released one it starts at zero and pays its length. Unlike there it adds to the neck that was
    tracked, instead of replacing it, and is kept: the avatar's clip has it.
    """

    def __init__(self, capture: Capture) -> None:
        super().__init__(capture)
        # One parameter a frame: Adam passes by those that got no gradient, as SparseAdam does.
        self.offsets = nn.ParameterList(torch.zeros(3) for _ in range(len(capture)))

    def at(self, frame: int) -> Corrected:
        """The parameters of a frame with its neck turned."""
        pose = super().at(frame).pose
        return Corrected(replace(pose, neck_rot=pose.neck_rot + self.offsets[frame]), None)

    def penalty(self, frame: int) -> torch.Tensor:
        """Length of the frame's offset, rad (fact 35)."""
        return self.offsets[frame].norm()

    def corrected(self, clip: Clip) -> Clip:
        """The capture's clip with the offsets."""
        offsets = np.stack([x.detach().cpu().numpy() for x in self.offsets])
        return replace(clip, neck_rot=(clip.neck_rot + offsets).astype(np.float32))


class Corrections(nn.Module):
    """The corrections of one capture of T frames.

    Args:
        capture: Its tracked parameters are the starting point.
        trained: bool[T] frames with a training image.
        pivot: [3] m, head-fixed frame: rotations are corrected about it, so that they do not also translate.
        video: Whether neighbouring frames are moments apart; stills share no residual.
    """

    def __init__(self, capture: Capture, trained: np.ndarray, pivot: np.ndarray, *, video: bool) -> None:
        super().__init__()
        self.n_expr = capture.expr.shape[1]
        tracked = {
            name: torch.from_numpy(getattr(capture, name).copy()) for name in (*POSE_FIELDS, "jaw_rot")
        }
        for name, value in tracked.items():
            self.register_buffer(name, value, persistent=False)
        self.register_buffer("features", torch.from_numpy(_features(capture, trained)), persistent=False)
        self.register_buffer("kernel", torch.from_numpy(_smoothing(trained, video)), persistent=False)
        self.register_buffer("pivot", torch.as_tensor(pivot, dtype=torch.float32), persistent=False)
        self.register_buffer("unit", _units(self.n_expr), persistent=False)
        outputs = len(self.unit)
        self.linear = nn.Parameter(torch.zeros(self.features.shape[1], outputs))
        self.residual = nn.Parameter(torch.zeros(int(trained.sum()), outputs))

    def at(self, frame: int) -> Corrected:
        """The corrected parameters of a frame."""
        steps = (self.features[frame] @ self.linear + self.kernel[frame] @ self.residual) * self.unit
        rot, tra, expr, eye_rot, neck_rot = steps.split([3, 3, self.n_expr, 3, 3])
        pose = Pose(
            self.expr[frame] + expr,
            self.eye_rot[frame] + eye_rot,
            self.neck_rot[frame] + neck_rot,
            self.jaw_rot[frame],
        )
        rotmat = axis_angle_to_rotmat(rot)
        return Corrected(pose, (rotmat, self.pivot - rotmat @ self.pivot + tra))

    def penalty(self, frame: int) -> torch.Tensor:
        """Mean squared residual plus mean squared column of the linear map, in units of the expected size.

        Of all frames, whichever is looked at.
        """
        return self.residual.square().mean() + self.linear.square().sum(0).mean()

    def corrected(self, clip: Clip) -> Clip:
        """The capture's clip with everything corrected."""
        flip = np.array([1.0, -1.0, -1.0])
        frames = []
        with torch.no_grad():
            for t in range(len(self.expr)):
                c = self.at(t)
                head = axis_angle_to_rotmat(self.rot[t].double().numpy())
                rotmat = head @ (flip[:, None] * c.rigid[0].double().numpy() * flip)
                tra = head @ (flip * c.rigid[1].double().numpy()) + self.tra[t].double().numpy()
                p = c.pose
                frames.append(
                    (rotmat_to_axis_angle(rotmat), tra, p.expr.numpy(), p.eye_rot.numpy(), p.neck_rot.numpy())
                )
        tracks = zip(POSE_FIELDS, zip(*frames, strict=True), strict=True)
        return replace(clip, **{name: np.stack(values).astype(np.float32) for name, values in tracks})


def corrections_named(
    name: str, capture: Capture, trained: np.ndarray, pivot: np.ndarray, *, video: bool
) -> Corrections | NeckOffsets | Uncorrected:
    """What `Preset.corrections` calls by this name; the other arguments are those of `Corrections`."""
    if name == "auto":
        name = "none" if len(capture.cameras) > 1 else "tracked"
    if name == "tracked":
        return Corrections(capture, trained, pivot, video=video)
    return NeckOffsets(capture) if name == "neck" else Uncorrected(capture)


def _units(n_expr: int) -> torch.Tensor:
    lengths = {"expr": n_expr}
    return torch.cat([torch.full((lengths.get(n, 3),), EXPECTED_SIZE[n]) for n in POSE_FIELDS])


def _features(capture: Capture, trained: np.ndarray) -> np.ndarray:
    """float32[T, F] tracked parameters, standardised over the trained frames, over sqrt(F)."""
    raw = np.concatenate([getattr(capture, name) for name in POSE_FIELDS], 1).astype(np.float64)
    seen = raw[trained]
    spread = seen.std(0)
    scaled = np.where(spread > 1e-6, (raw - seen.mean(0)) / np.maximum(spread, 1e-6), 0)
    return (np.clip(scaled, -3, 3) / np.sqrt(scaled.shape[1])).astype(np.float32)


def _smoothing(trained: np.ndarray, video: bool) -> np.ndarray:
    """float32[T, K]: each frame's weights over the K trained frames, a normalised Gaussian in time.

    Away from the trained frames the nearest one's residual fades to none: the tracker's errors do not last.
    Stills have their own residual, or none.
    """
    if not video:
        return np.eye(len(trained), dtype=np.float32)[:, trained]
    times = np.arange(len(trained), dtype=np.float64)
    distance2 = (times[:, None] - times[trained]) ** 2
    exponent = -(distance2 - distance2.min(1, keepdims=True)) / (2 * KERNEL_FRAMES**2)
    weights = np.exp(exponent)
    fade = np.exp(-distance2.min(1, keepdims=True) / (2 * FADE_FRAMES**2))
    return (fade * weights / weights.sum(1, keepdims=True)).astype(np.float32)
