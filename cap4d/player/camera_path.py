"""How the camera of an offline render moves: it stands, orbits, or follows a file. Head-fixed world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cap4d.camera import Camera, head_fixed, is_rigid, look_at
from cap4d.drive.clip import Frame
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.npz import checked, read_npz

ORBIT_YAW, ORBIT_PITCH, ORBIT_SECONDS = 55.0, 20.0, 8.0  # degrees and s (fact 51)
NEAR_METRES = 0.25  # of a live head from its own place
MAX_SIDE = 16384  # px
CAMERA_FIELDS = frozenset({"extr", "fx", "fy", "cx", "cy", "resolution", "resolutions"})

STANDING = ("static", "orbit")  # paths in the head-fixed world

CameraPath = Callable[[int, Frame], Camera]
"""(number of the frame, the driven frame) -> camera in the head-fixed world."""


def camera_path(
    spec: str, default: Camera, target: np.ndarray, *, fps: float, size: tuple[int, int] | None
) -> CameraPath:
    """The path that `--camera` names.

    Args:
        spec: `static`, the default view; `orbit`, fact 51's; or a file, see `file_path`.
        default: The avatar's own view.
        target: [3] m, the middle of the head, head-fixed world.
        fps: Of the frames that will be asked for.
        size: (width, height) px of the pictures; None is the path's own.
    Raises:
        ArgumentError, DataError: See `file_path`.
    """
    if spec == "static":
        return static_path(fitted(default, size))
    if spec == "orbit":
        return orbit_path(fitted(default, size), target, fps=fps)
    return file_path(Path(spec), size)


def static_path(camera: Camera) -> CameraPath:
    """The camera stands."""
    return lambda _index, _frame: camera


def orbit_path(camera: Camera, target: np.ndarray, *, fps: float) -> CameraPath:
    """Around the head at the camera's distance: yaw 55 degrees cos, pitch 20 degrees sin, 8 s a round."""
    depth = float(camera.viewmat[2, :3] @ target + camera.viewmat[2, 3])
    K = camera.K.copy()
    K[:2, 2] = camera.width / 2, camera.height / 2
    camera = replace(camera, K=K)

    def at(index: int, _frame: Frame) -> Camera:
        phase = 2 * np.pi * index / fps / ORBIT_SECONDS
        yaw, pitch = np.radians(ORBIT_YAW) * np.cos(phase), np.radians(ORBIT_PITCH) * np.sin(phase)
        away = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), -np.cos(yaw) * np.cos(pitch)])
        return replace(camera, viewmat=look_at(target + depth * away, target))

    return at


def file_path(path: Path, size: tuple[int, int] | None) -> CameraPath:
    """Cameras of a world in which the driven head moves: a trajectory (fact 46) or a fit.npz's first.

    A trajectory gives one camera a frame and starts again at its end; the head's pose is folded in (fact 31).

    Raises:
        ArgumentError: There is no such file.
        DataError: It is not sound.
    """
    if not path.is_file():
        raise ArgumentError(f"camera: expected static, orbit or an .npz of cameras, got {path}")
    cameras = [fitted(camera, size) for camera in read_cameras(path)]

    def at(index: int, frame: Frame) -> Camera:
        camera = cameras[index % len(cameras)]
        if frame.rot is None or frame.tra is None:
            return camera
        return replace(camera, viewmat=head_fixed(camera.viewmat, frame.rot, frame.tra))

    return at


def live_camera_path(
    spec: str, default: Camera, target: np.ndarray, *, fps: float, size: tuple[int, int] | None
) -> CameraPath:
    """`camera_path` for a source that comes live: every path sees the head turn."""
    path = camera_path(spec, default, target, fps=fps, size=size)
    if spec not in STANDING:
        return path  # cameras in the head's own world, whose pose they fold in
    return lambda index, frame: with_live_head(path(index, frame), frame)


def with_live_head(camera: Camera, frame: Frame) -> Camera:
    """The same view of a head that turns as a live source says (fact 31).

    Where it stands (`tra`) is only taken over where that is near the head's own place: a webcam's metres
    would take it out of the picture.
    """
    if frame.rot is None:
        return camera
    tra = np.zeros(3) if frame.tra is None or np.linalg.norm(frame.tra) > NEAR_METRES else frame.tra
    return replace(camera, viewmat=head_fixed(camera.viewmat, frame.rot, tra))


def fitted(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """The same view on a picture of (width, height): all of it is seen, centred, nothing is stretched."""
    if size is None or size == (camera.width, camera.height):
        return camera
    width, height = size
    scale = min(width / camera.width, height / camera.height)
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += (width - scale * camera.width) / 2, (height - scale * camera.height) / 2
    return replace(camera, K=K, width=width, height=height)


def read_cameras(path: Path) -> list[Camera]:
    """The cameras of a trajectory, or the first one of a fit.npz, in the world.

    Raises:
        DataError: The file is not sound.
    """
    arrays = read_npz(path, names=CAMERA_FIELDS)
    is_fit = "resolution" not in arrays
    extr = checked(path, "extr", arrays.get("extr"), kind="float", shape=(None, 4, 4)).astype(np.float64)
    if not len(extr):
        raise DataError(path, "extr", expected="at least one camera", found="none")
    for i, viewmat in enumerate(extr):
        if not is_rigid(viewmat):
            raise DataError(path, f"extr[{i}]", expected="a rigid motion", found=viewmat.tolist())
    focal = {
        n: checked(path, n, arrays.get(n), kind="float", shape=(len(extr), 1))
        for n in ("fx", "fy", "cx", "cy")
    }
    shape = (len(extr), 2) if is_fit else (2,)
    name = "resolutions" if is_fit else "resolution"
    sizes = np.atleast_2d(checked(path, name, arrays.get(name), kind="index", shape=shape))
    if sizes.min() < 1 or sizes.max() > MAX_SIDE:
        raise DataError(path, name, expected=f"1 to {MAX_SIDE} px", found=sizes[0].tolist())
    if min(focal["fx"].min(), focal["fy"].min()) <= 0:
        raise DataError(path, "fx, fy", expected="positive focal lengths", found=float(focal["fx"].min()))
    height, width = (int(n) for n in sizes[0])
    cameras = []
    for i, viewmat in enumerate(extr[:1] if is_fit else extr):
        fx, fy, cx, cy = (float(focal[n][i, 0]) for n in ("fx", "fy", "cx", "cy"))
        cameras.append(Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), viewmat, width, height))
    return cameras
