"""A sequence of face expressions with its own clock: what every source becomes before it drives an avatar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.errors import ArgumentError


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a driven head.

    Args:
        t: Seconds on the stream's own clock.
        rig_name: The rig whose expression space `expr` lives in.
        expr: float32[E].
        eye_rot, neck_rot, jaw_rot: float32[3] axis-angle, rad.
        rot, tra: float32[3] the head's pose in the source's world, rig axes; None: it has none.
    """

    t: float
    rig_name: str
    expr: np.ndarray
    eye_rot: np.ndarray
    neck_rot: np.ndarray
    jaw_rot: np.ndarray
    rot: np.ndarray | None = None
    tra: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Clip:
    """T frames at a constant rate.

    Args:
        rig_name: See `Frame`.
        fps: Frames per second.
        expr: float32[T, E].
        eye_rot, neck_rot, jaw_rot: float32[T, 3].
        rot, tra: float32[T, 3], or None where the source knows no head pose.
    """

    rig_name: str
    fps: float
    expr: np.ndarray
    eye_rot: np.ndarray
    neck_rot: np.ndarray
    jaw_rot: np.ndarray
    rot: np.ndarray | None = None
    tra: np.ndarray | None = None

    def __post_init__(self) -> None:
        frames = len(self.expr)
        if frames < 1 or self.expr.ndim != 2:
            raise ArgumentError(
                f"expr: expected float32[T, E] with T >= 1, got {self.expr.dtype}{list(self.expr.shape)}"
            )
        if not self.fps > 0:
            raise ArgumentError(f"fps: expected a positive number, got {self.fps}")
        for name in ("eye_rot", "neck_rot", "jaw_rot", "rot", "tra"):
            value = getattr(self, name)
            if value is not None and value.shape != (frames, 3):
                raise ArgumentError(
                    f"{name}: expected float32[{frames}, 3], got {value.dtype}{list(value.shape)}"
                )

    def __len__(self) -> int:
        return len(self.expr)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the end of the last."""
        return len(self) / self.fps

    def frame(self, index: int) -> Frame:
        """Frame `index`; beyond the end the clip repeats."""
        i = index % len(self)
        pose = {
            name: None if getattr(self, name) is None else getattr(self, name)[i] for name in ("rot", "tra")
        }
        return Frame(
            index / self.fps,
            self.rig_name,
            self.expr[i],
            self.eye_rot[i],
            self.neck_rot[i],
            self.jaw_rot[i],
            **pose,
        )
