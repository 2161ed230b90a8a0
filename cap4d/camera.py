"""Pinhole cameras, and the only place where the rig's axes (y up) and OpenCV's (y down) meet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cap4d.errors import ArgumentError
from cap4d.rotation import Array, axis_angle_to_rotmat

NEAR = 0.01  # m; the splatting renderers cull Gaussians whose centre is nearer (gsplat's default)

OPENCV_FROM_RIG = np.diag([1.0, -1.0, -1.0])
"""Rigs have x to the person's left, y up, the face to +z (FLAME); cameras y down, z away (fact 10)."""


def opencv_from_rig(points: Array) -> Array:
    """Flips [..., 3] points or offsets between the rig's axes and OpenCV's. Its own inverse."""
    flip = OPENCV_FROM_RIG.diagonal()
    return points * (flip.astype(points.dtype) if isinstance(points, np.ndarray) else points.new_tensor(flip))


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes (+x right, +y down, +z forward) and pixel centres at .5.

    Args:
        K: float64[3, 3] intrinsics, px.
        viewmat: float64[4, 4] view from world, metres.
        width, height: image size, px.
    """

    K: np.ndarray
    viewmat: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.asarray(self.K, np.float64))
        object.__setattr__(self, "viewmat", np.asarray(self.viewmat, np.float64))
        if self.K.shape != (3, 3) or not np.isfinite(self.K).all():
            raise ArgumentError(f"K: expected finite float64[3, 3], got {self.K.dtype}{list(self.K.shape)}")
        if self.viewmat.shape != (4, 4) or not np.isfinite(self.viewmat).all():
            raise ArgumentError(
                f"viewmat: expected finite float64[4, 4], got {self.viewmat.dtype}{list(self.viewmat.shape)}"
            )
        if self.width < 1 or self.height < 1:
            raise ArgumentError(f"size: expected at least 1x1, got {self.width}x{self.height}")

    @property
    def position(self) -> np.ndarray:
        """[3] the optical centre in the world, m."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another number of pixels."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, K=scale @ self.K, width=width, height=height)

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Camera:
        """The same view through a window of the image; the window may reach beyond it."""
        K = self.K.copy()
        K[:2, 2] -= [x0, y0]
        return replace(self, K=K, width=width, height=height)

    def project(self, points: np.ndarray) -> np.ndarray:
        """World [..., 3] m -> [..., 3]: x px, y px, depth m."""
        view = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        pixels = view @ self.K.T
        return np.concatenate([pixels[..., :2] / view[..., 2:], view[..., 2:]], -1)


def is_rigid(viewmat: np.ndarray) -> bool:
    """Whether [4, 4] is a rotation (to 1e-3, no mirror) and a translation of less than 10 km; no NaN is."""
    viewmat = np.asarray(viewmat, np.float64)
    if not np.abs(viewmat).max() < 1e4 or viewmat[3].tolist() != [0, 0, 0, 1]:
        return False
    rotation = viewmat[:3, :3]
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    return bool(orthonormal and np.linalg.det(rotation) > 0)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[4, 4] viewmat of a camera at `eye` looking at `target` (OpenCV world, so up is -y)."""
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    down = np.array([0.0, 1.0, 0.0])
    right = np.cross(down, forward)
    norm = np.linalg.norm(right)
    right = right / norm if norm > 1e-9 else np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return viewmat


def orbit_camera(
    *,
    yaw_deg: float,
    pitch_deg: float,
    distance: float,
    target: np.ndarray,
    fov_y_deg: float,
    width: int,
    height: int,
) -> Camera:
    """A camera on a sphere around `target` (OpenCV world): yaw 0 is in front, positive pitch above."""
    yaw, pitch = np.radians(yaw_deg), np.radians(pitch_deg)
    away = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), -np.cos(yaw) * np.cos(pitch)])
    focal = 0.5 * height / np.tan(np.radians(fov_y_deg) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(K, look_at(np.asarray(target) + distance * away, target), width, height)


def head_fixed(viewmat: np.ndarray, rot: np.ndarray, tra: np.ndarray) -> np.ndarray:
    """Folds the head's pose into the camera, so that the head stands still (fact 31).

    Args:
        viewmat: [4, 4] view from world.
        rot, tra: [3] the head's axis-angle rotation about the rig's origin and translation, rig axes, m.
    Returns:
        [4, 4] view from head, the head in OpenCV axes.
    """
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    pose = np.eye(4)
    pose[:3, :3] = axis_angle_to_rotmat(np.asarray(rot, np.float64))
    pose[:3, 3] = tra
    return np.asarray(viewmat, np.float64) @ flip @ pose @ flip
