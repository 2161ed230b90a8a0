"""The scenes that splatting is measured on: a folder of files, or the package's own."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.camera import Camera, is_rigid
from cap4d.errors import ArgumentError, DataError
from cap4d.evaluate.bench import synthetic
from cap4d.gaussians import SH_COUNTS, Gaussians
from cap4d.rig.npz import checked_float32, read_npz

NAMES = ("head_30k", "head_100k", "head_300k", "bad_30k", "bad_100k")
CAMERAS = "cameras.json"
MAX_JSON_BYTES = 1 << 24
MAX_SIDE = 8192  # px
FIELDS = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians and the view they are drawn from."""

    name: str
    gaussians: Gaussians
    camera: Camera

    @property
    def fields(self) -> tuple[np.ndarray, ...]:
        """means, quats, scales, opacities, sh: as `_core` takes them."""
        g = self.gaussians
        return g.means, g.quats, g.scales, g.opacities, g.sh

    @property
    def view(self) -> tuple[np.ndarray, np.ndarray, int, int]:
        """viewmat, K, width, height: as `_core` takes them."""
        c = self.camera
        return c.viewmat, c.K, c.width, c.height

    def resized(self, side: int) -> Scene:
        return replace(self, camera=self.camera.resized(side, side))

    def with_sh_degree(self, degree: int) -> Scene:
        """The same with the coefficients of higher degrees taken out of the arrays."""
        g = self.gaussians
        sh = np.ascontiguousarray(g.sh[:, : (degree + 1) ** 2])
        return replace(self, gaussians=Gaussians(g.means, g.quats, g.scales, g.opacities, sh))


@dataclass(frozen=True)
class SceneSource:
    """Where scenes come from: a folder, or None for the package's own. Cheap to hand to another process."""

    folder: str | None = None

    def load(self, name: str, *, count: int | None = None) -> Scene:
        """One scene.

        Args:
            name: One of `NAMES`, or any `head_*` or `bad_*` with `count`.
            count: Gaussians of the package's own scene, whatever its name says.
        Raises:
            DataError: A file is missing or not sound.
        """
        if self.folder is not None:
            return read_scene(Path(self.folder), name)
        make = synthetic.fog_scene if name.startswith("bad") else synthetic.head_scene
        return Scene(name, make(count or gaussian_count(name)), synthetic.front_camera())

    @property
    def kind(self) -> str:
        return "the package's own, seeded" if self.folder is None else "files of the given folder"


def gaussian_count(name: str) -> int:
    """head_30k -> 30,000"""
    return 1000 * int(name.rsplit("_", 1)[1].removesuffix("k"))


def check_folder(folder: Path) -> SceneSource:
    """A folder with all the files, each looked at when it is loaded.

    Raises:
        ArgumentError: It is no folder.
        DataError: A file is missing.
    """
    if not folder.is_dir():
        raise ArgumentError(f"scenes: expected a folder, found none at {folder}")
    for file in (CAMERAS, *(f"{name}.npz" for name in NAMES)):
        if not (folder / file).is_file():
            raise DataError(folder / file, "file", expected="a scene's file", found="no such file")
    return SceneSource(str(folder))


def read_scene(folder: Path, name: str) -> Scene:
    """`{name}.npz` with activated means, quats, scales, opacities and sh, seen from the first of
    `cameras.json`.

    Raises:
        DataError: One of them is not sound.
    """
    path = folder / f"{name}.npz"
    arrays = read_npz(path, names=(*FIELDS, "sh"))
    means = checked_float32(path, "means", arrays.get("means"), shape=(None, 3))
    n = len(means)
    fields = [checked_float32(path, k, arrays.get(k), shape=(n, *shape)) for k, shape in FIELDS.items()]
    sh = checked_float32(path, "sh", arrays.get("sh"), shape=(n, None, 3))
    if sh.shape[1] not in SH_COUNTS:
        raise DataError(path, "sh", expected="1, 4, 9 or 16 coefficients", found=sh.shape[1])
    return Scene(name, Gaussians(*fields, sh), read_camera(folder / CAMERAS))


def read_camera(path: Path) -> Camera:
    """The first view of a JSON file with width, height, fx, fy, cx, cy and viewmats [V][4][4].

    Raises:
        DataError: It is not such a file.
    """
    found = _read_json(path)
    sides = [_number(path, found, name) for name in ("width", "height")]
    if not all(1 <= side <= MAX_SIDE and side == int(side) for side in sides):
        raise DataError(path, "size", expected=f"whole sides of 1 to {MAX_SIDE} px", found=sides)
    fx, fy, cx, cy = (_number(path, found, name) for name in ("fx", "fy", "cx", "cy"))
    if not (fx > 0 and fy > 0):
        raise DataError(path, "fx, fy", expected="positive focal lengths", found=[fx, fy])
    views = found.get("viewmats")
    try:
        viewmat = np.array(views[0], np.float64)
    except (TypeError, ValueError, IndexError, KeyError):
        viewmat = np.zeros(0)
    if viewmat.shape != (4, 4) or not is_rigid(viewmat):
        raise DataError(path, "viewmats", expected="4x4 rigid matrices", found=str(views)[:80])
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Camera(K, viewmat, int(sides[0]), int(sides[1]))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise DataError(
                path, "size", expected=f"at most {MAX_JSON_BYTES} bytes", found=path.stat().st_size
            )
        found = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise DataError(path, "file", expected="cameras as JSON", found="no such file") from None
    except (ValueError, RecursionError) as error:
        raise DataError(path, "file", expected="cameras as JSON", found=str(error)) from None
    if not isinstance(found, dict):
        raise DataError(path, "file", expected="an object", found=type(found).__name__)
    return found


def _number(path: Path, found: dict[str, Any], name: str) -> float:
    value = found.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(path, name, expected="a finite number", found=value)
    return float(value)
