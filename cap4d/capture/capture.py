"""A capture: a person as images, mattes, cameras and rig parameters, in the FlowFace layout (facts 40-41).

A reference folder of the released CAP4D is a capture as it stands; ours add `rig_name` and `held_out`.
Reading and writing only: tracking is in track/, fitting in avatar/.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cap4d.atomic import replacing
from cap4d.camera import Camera, head_fixed, is_rigid
from cap4d.capture.image import IMAGE_SUFFIXES, composite, read_image
from cap4d.drive.clip import Clip
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.flame import RELEASED_RIG
from cap4d.rig.npz import checked, checked_float32, read_npz

POSE_FIELDS = ("rot", "tra", "eye_rot", "neck_rot", "jaw_rot")
OPTIONAL_POSE_FIELDS = ("neck_rot", "jaw_rot")
CAMERA_FIELDS = ("camera_order", "fx", "fy", "cx", "cy", "extr", "resolutions")
FIELDS = frozenset(
    {"shape", "expr", "fps", "rig_name", "valid_mask", "held_out", "error", *POSE_FIELDS, *CAMERA_FIELDS}
)
"""What is read of a fit.npz; a tracker may leave more in it."""
MAX_FRAMES = 1_000_000


class View(NamedTuple):
    """One image of a capture. `frame` indexes the rig parameters; `matte` is None where there is none."""

    camera: str
    frame: int
    image: Path
    matte: Path | None


@dataclass(frozen=True, eq=False)
class Capture:
    """A person on disk; T frames, E expressions, S identity modes, C cameras.

    Args:
        path: The folder.
        rig_name: Whose parameters these are; None in released folders (then `RELEASED_RIG` is meant).
        shape: float32[S].
        expr: float32[T, E].
        rot, tra: float32[T, 3] head pose in the world, rig axes, rad and m (fact 9).
        eye_rot, neck_rot, jaw_rot: float32[T, 3] rad; zero where the file has none.
        cameras: By name, in the order of the file; `viewmat` is view from world (fact 10).
        fps: Frames per second.
        views: The images, in the order of reference_images.json (all valid frames without it).
        held_out: bool[T] frames kept for evaluation, never trained on; None: unmarked.
        error: Tracking error, px; None: unknown.
    """

    path: Path
    rig_name: str | None
    shape: np.ndarray
    expr: np.ndarray
    rot: np.ndarray
    tra: np.ndarray
    eye_rot: np.ndarray
    neck_rot: np.ndarray
    jaw_rot: np.ndarray
    cameras: dict[str, Camera]
    fps: float
    views: tuple[View, ...]
    held_out: np.ndarray | None = None
    error: float | None = None

    @staticmethod
    def load(path: str | Path) -> Capture:
        """Reads `fit.npz` and finds the images; every size, dtype, value and name is checked. No pickle.

        Raises:
            DataError: Naming the file, the field, what was expected and what was found.
        """
        path = Path(path)
        return _build(path, _Fit(path / "fit.npz"))

    def __len__(self) -> int:
        """Frames, seen or not."""
        return len(self.expr)

    def camera(self, view: View) -> Camera:
        """The camera of `view` in the world."""
        return self.cameras[view.camera]

    def head_camera(self, view: View) -> Camera:
        """The camera of `view` in the head-fixed world, OpenCV axes (fact 31)."""
        camera = self.cameras[view.camera]
        viewmat = head_fixed(camera.viewmat, self.rot[view.frame], self.tra[view.frame])
        return Camera(camera.K, viewmat, camera.width, camera.height)

    def image(self, view: View) -> np.ndarray:
        """float32[H, W, 3] composited on white with the matte, or with the image's own alpha (fact 40)."""
        pixels = read_image(view.image)
        self._check_size(view, view.image, pixels)
        rgb = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, -1)
        alpha = self.matte(view)
        if alpha is None and pixels.shape[2] in (2, 4):
            alpha = pixels[..., -1]
        return rgb if alpha is None else composite(rgb, alpha)

    def matte(self, view: View) -> np.ndarray | None:
        """float32[H, W] coverage of the person in [0, 1], or None."""
        if view.matte is None:
            return None
        pixels = read_image(view.matte)
        self._check_size(view, view.matte, pixels)
        return np.ascontiguousarray(pixels[..., 0])

    def clip(self) -> Clip:
        """The capture's expressions and poses as something that drives an avatar."""
        poses = {name: getattr(self, name) for name in POSE_FIELDS}
        return Clip(self.rig_name or RELEASED_RIG, self.fps, self.expr, **poses)

    def _check_size(self, view: View, path: Path, pixels: np.ndarray) -> None:
        camera = self.cameras[view.camera]
        if pixels.shape[:2] != (camera.height, camera.width):
            found = f"{pixels.shape[1]}x{pixels.shape[0]}"
            raise DataError(
                path, "size", expected=f"{camera.width}x{camera.height} as in fit.npz", found=found
            )


def save_capture(
    path: str | Path,
    *,
    rig_name: str,
    shape: np.ndarray,
    expr: np.ndarray,
    rot: np.ndarray,
    tra: np.ndarray,
    cameras: Mapping[str, Camera],
    fps: float = 30.0,
    eye_rot: np.ndarray | None = None,
    neck_rot: np.ndarray | None = None,
    jaw_rot: np.ndarray | None = None,
    valid: np.ndarray | None = None,
    held_out: np.ndarray | None = None,
    error: float | None = None,
    references: Sequence[tuple[str, int]] | None = None,
) -> None:
    """Writes `fit.npz` and, with `references`, `reference_images.json` into the folder (made if need be).

    The caller writes images, `images/<camera>/<frame:05d>.png`, and mattes, `bg/<camera>/<frame:04d>.png`.

    Args:
        path: The capture's folder.
        cameras: By name; `viewmat` is view from world. The other arrays are as in `Capture`.
        valid: bool[C, T] which frames were tracked; None: all.
        references: (camera, frame) of the images an avatar is made from; None: all valid frames.
    Raises:
        ArgumentError: An array has the wrong shape or is not finite; or a file cannot be written.
    """
    path, frames = Path(path), len(expr)
    zeros = np.zeros((frames, 3))
    poses = dict(rot=rot, tra=tra, eye_rot=eye_rot, neck_rot=neck_rot, jaw_rot=jaw_rot)
    arrays = {name: _float32(name, zeros if v is None else v, (frames, 3)) for name, v in poses.items()}
    arrays["shape"] = _float32("shape", shape, (len(shape),))
    arrays["expr"] = _float32("expr", expr, (frames, np.shape(expr)[1]))
    arrays |= _camera_arrays(cameras)
    arrays["rig_name"] = np.array(rig_name)
    arrays["fps"] = np.float64(fps)
    arrays["n_timesteps"], arrays["n_views"] = np.int64(frames), np.int64(len(cameras))
    arrays["valid_mask"] = np.ones((len(cameras), frames), bool) if valid is None else np.asarray(valid, bool)
    if held_out is not None:
        arrays["held_out"] = np.asarray(held_out, bool)
    if error is not None:
        arrays["error"] = np.float64(error)
    path.mkdir(parents=True, exist_ok=True)
    with replacing(path / "fit.npz") as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)
    if references is not None:
        listing = json.dumps([[camera, int(frame)] for camera, frame in references], indent=1)
        with replacing(path / "reference_images.json") as temporary:
            temporary.write_text(listing, encoding="utf-8")


def _camera_arrays(cameras: Mapping[str, Camera]) -> dict[str, np.ndarray]:
    K = np.stack([camera.K for camera in cameras.values()]).astype(np.float32)
    return {
        "fx": K[:, :1, 0],
        "fy": K[:, 1:2, 1],
        "cx": K[:, :1, 2],
        "cy": K[:, 1:2, 2],
        "extr": np.stack([camera.viewmat for camera in cameras.values()]).astype(np.float32),
        "resolutions": np.array([[camera.height, camera.width] for camera in cameras.values()], np.int64),
        "camera_order": np.array(list(cameras)),
    }


def _float32(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(value)
    if value.shape != shape or not np.isfinite(value).all():
        raise ArgumentError(
            f"{name}: expected finite float32{list(shape)}, got {value.dtype}{list(value.shape)}"
        )
    return value.astype(np.float32)


class _Fit:
    """fit.npz, checked field by field."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays = read_npz(path, names=FIELDS)

    def numbers(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        return checked_float32(self.path, name, self.arrays.get(name), shape=shape)

    def flags(self, name: str, shape: tuple[int, ...]) -> np.ndarray | None:
        if name not in self.arrays:
            return None
        return checked(self.path, name, self.arrays[name], kind="bool", shape=shape)

    def texts(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        return checked(self.path, name, self.arrays.get(name), kind="text", shape=shape)

    def number(self, name: str, *, positive: bool = False) -> float | None:
        if name not in self.arrays:
            return None
        value = float(self.numbers(name, ()))
        if positive and value <= 0:
            raise DataError(self.path, name, expected="a positive number", found=value)
        return value


def _build(path: Path, fit: _Fit) -> Capture:
    expr = fit.numbers("expr", (None, None))
    frames = len(expr)
    if not 1 <= frames <= MAX_FRAMES:
        raise DataError(fit.path, "expr", expected=f"1 to {MAX_FRAMES} frames", found=frames)
    poses: dict[str, Any] = {}
    for name in POSE_FIELDS:
        absent = name in OPTIONAL_POSE_FIELDS and name not in fit.arrays
        poses[name] = np.zeros((frames, 3), np.float32) if absent else fit.numbers(name, (frames, 3))
    cameras = _cameras(fit)
    return Capture(
        path=path,
        rig_name=str(fit.texts("rig_name", ())) if "rig_name" in fit.arrays else None,
        shape=fit.numbers("shape", (None,)),
        expr=expr,
        cameras=cameras,
        fps=fit.number("fps", positive=True) or 30.0,
        views=_views(path, fit, cameras, frames),
        held_out=fit.flags("held_out", (frames,)),
        error=fit.number("error"),
        **poses,
    )


def _cameras(fit: _Fit) -> dict[str, Camera]:
    names = fit.texts("camera_order", (None,))
    if not len(names):
        raise DataError(fit.path, "camera_order", expected="at least one camera", found="none")
    n = len(names)
    fx, fy, cx, cy = (fit.numbers(name, (n, 1))[:, 0] for name in ("fx", "fy", "cx", "cy"))
    extr, sizes = fit.numbers("extr", (n, 4, 4)), fit.numbers("resolutions", (n, 2))
    cameras: dict[str, Camera] = {}
    for i, name in enumerate(map(str, names)):
        if not _is_plain(name) or name in cameras:
            raise DataError(
                fit.path, "camera_order", expected="distinct plain folder names", found=repr(name)
            )
        if fx[i] <= 0 or fy[i] <= 0:
            raise DataError(fit.path, "fx, fy", expected="positive focal lengths", found=f"{fx[i]}, {fy[i]}")
        if not is_rigid(extr[i]):
            raise DataError(fit.path, f"extr[{i}]", expected="a rigid motion", found=extr[i].tolist())
        height, width = sizes[i]
        if not (1 <= height <= 65536 and 1 <= width <= 65536):
            raise DataError(fit.path, "resolutions", expected="1 to 65536 px", found=f"{height}, {width}")
        K = np.array([[fx[i], 0, cx[i]], [0, fy[i], cy[i]], [0, 0, 1]], np.float64)
        cameras[name] = Camera(K, extr[i], int(width), int(height))
    return cameras


def _views(path: Path, fit: _Fit, cameras: dict[str, Camera], frames: int) -> tuple[View, ...]:
    files = {name: _image_files(path / "images" / name) for name in cameras}
    listing = path / "reference_images.json"
    if listing.exists():
        wanted = read_listing(listing, cameras, frames)
    else:
        valid = fit.flags("valid_mask", (len(cameras), frames))
        wanted = [
            (name, t)
            for c, name in enumerate(cameras)
            for t in range(frames)
            if (valid is None or valid[c, t]) and _image_of(files[name], t, frames)
        ]
    views = []
    for name, frame in wanted:
        image = _image_of(files[name], frame, frames)
        if image is None:
            found = f"{len(files[name])} images"
            raise DataError(path / "images" / name, f"frame {frame}", expected="an image", found=found)
        matte = path / "bg" / name / f"{frame:04d}.png"
        views.append(View(name, frame, image, matte if matte.is_file() else None))
    if not views:
        raise DataError(path / "images", "files", expected="an image of a tracked frame", found="none")
    return tuple(views)


def read_listing(listing: Path, cameras: Mapping[str, Camera], frames: int) -> list[tuple[str, int]]:
    """(camera, frame) pairs of a reference_images.json; every name and number is checked.

    Raises:
        DataError: It is not such a list.
    """
    try:
        entries = json.loads(listing.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(listing, "file", expected="JSON", found=error) from error
    if not isinstance(entries, list):
        raise DataError(listing, "file", expected="a list of [camera, frame]", found=type(entries).__name__)
    pairs = []
    for i, entry in enumerate(entries):
        known = (
            isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str) and entry[0] in cameras
        )
        if not known or type(entry[1]) is not int or not 0 <= entry[1] < frames:
            wanted = f"[a camera of fit.npz, 0..{frames - 1}]"
            raise DataError(listing, f"entry {i}", expected=wanted, found=json.dumps(entry)[:80])
        pairs.append((entry[0], entry[1]))
    return pairs


def _image_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(
        f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith(".")
    )


def _image_of(files: list[Path], frame: int, frames: int) -> Path | None:
    """The image of a frame: by its place (fact 40), or, in a folder that lacks frames, by its number."""
    if len(files) < frames and all(f.stem.isdecimal() for f in files):
        return next((f for f in files if int(f.stem) == frame), None)
    return files[frame] if frame < len(files) else None


def _is_plain(name: str) -> bool:
    """One path component that stays in its folder on any system."""
    return name not in ("", ".", "..") and not set(name) & set("/\\:\0") and name == name.strip()
