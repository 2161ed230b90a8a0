"""The viewer's camera: turning around a point, as pure maths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cap4d.camera import Camera, look_at, orbit_camera

MAX_PITCH_DEG = 85.0
DISTANCE_RANGE = 0.05, 20.0  # m
DEGREES_PER_HEIGHT = 180.0  # a drag over the whole window's height
ZOOM_PER_STEP = 0.9


@dataclass(frozen=True)
class Orbit:
    """A view from a sphere around `target`; see `cap4d.camera.orbit_camera`.

    Args:
        yaw_deg, pitch_deg: Where on the sphere; (0, 0) looks at the face.
        distance: m.
        target: The point looked at, head-fixed frame, m.
        fov_deg: Of the window's shorter side.
    """

    yaw_deg: float
    pitch_deg: float
    distance: float
    target: tuple[float, float, float]
    fov_deg: float

    @classmethod
    def from_camera(cls, camera: Camera, centre: np.ndarray) -> Orbit:
        """The orbit that starts where `camera` is, around the point of its axis nearest to `centre` [3] m.

        The view stays as it is, except that a rolled camera is set upright and the image centre becomes the
        principal point.
        """
        forward = camera.viewmat[2, :3]
        distance = float(np.clip((np.asarray(centre) - camera.position) @ forward, *DISTANCE_RANGE))
        side = min(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1])
        return cls(
            yaw_deg=float(np.degrees(np.arctan2(-forward[0], forward[2]))),
            pitch_deg=float(np.degrees(np.arcsin(np.clip(forward[1], -1, 1)))),
            distance=distance,
            target=tuple(float(x) for x in camera.position + distance * forward),
            fov_deg=float(np.degrees(2 * np.arctan(side / 2))),
        )

    def camera(self, width: int, height: int) -> Camera:
        """The pinhole camera for a window of `width` x `height` px."""
        fov = np.radians(self.fov_deg)
        if height > width:
            fov = 2 * np.arctan(np.tan(fov / 2) * height / width)
        return orbit_camera(
            yaw_deg=self.yaw_deg,
            pitch_deg=self.pitch_deg,
            distance=self.distance,
            target=np.array(self.target),
            fov_y_deg=float(np.degrees(fov)),
            width=width,
            height=height,
        )

    def turned(self, right: float, down: float) -> Orbit:
        """After a drag, in window heights; the head follows the pointer."""
        pitch = np.clip(self.pitch_deg + down * DEGREES_PER_HEIGHT, -MAX_PITCH_DEG, MAX_PITCH_DEG)
        yaw = (self.yaw_deg - right * DEGREES_PER_HEIGHT + 180) % 360 - 180
        return replace(self, yaw_deg=float(yaw), pitch_deg=float(pitch))

    def zoomed(self, steps: float) -> Orbit:
        """Nearer by `steps` of the wheel."""
        return replace(self, distance=float(np.clip(self.distance * ZOOM_PER_STEP**steps, *DISTANCE_RANGE)))

    def panned(self, right: float, down: float) -> Orbit:
        """After a drag, in shorter window sides; what is at the target's depth follows the pointer."""
        span = 2 * self.distance * np.tan(np.radians(self.fov_deg) / 2)
        rotation = self._viewmat()[:3, :3]
        target = np.array(self.target) - span * (right * rotation[0] + down * rotation[1])
        return replace(self, target=tuple(float(x) for x in target))

    def _viewmat(self) -> np.ndarray:
        camera = self.camera(1, 1)
        return look_at(camera.position, np.array(self.target))
