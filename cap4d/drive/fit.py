"""FlowFace sequences: the `fit.npz` that trackers write and CAP4D animates from (facts 41, 46)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.clip import Clip
from cap4d.errors import DataError
from cap4d.rig.flame import RELEASED_RIG
from cap4d.rig.npz import checked, checked_float32, read_npz

MAX_FRAMES = 200_000
FIELDS = frozenset({"expr", "eye_rot", "neck_rot", "jaw_rot", "rot", "tra", "rig_name", "fps"})
DEFAULT_FPS = 24.0  # of a sequence that names none (fact 46)


def read_fit(path: Path, bundle: Bundle, *, fps: float | None = None) -> Clip:
    """The expressions, gaze, neck and head pose of a fit.npz, for the avatar whose rig they belong to.

    The identity in it is left aside: expressions are transferred as they are (fact 46). A file without
    `rig_name` is a FLAME sequence of the released system.

    Raises:
        DataError: Not sound, or of another rig.
    """
    arrays = read_npz(path, names=FIELDS)
    _check_rig(path, arrays, bundle)
    return _clip(path, arrays, bundle.rig_name, bundle.n_expressions, fps)


def read_sequence(path: Path, *, fps: float | None = None) -> Clip:
    """The same for no avatar in particular: of the rig that the file names, or FLAME's.

    Raises:
        DataError: Not sound.
    """
    arrays = read_npz(path, names=FIELDS)
    name = RELEASED_RIG
    if "rig_name" in arrays:
        name = str(checked(path, "rig_name", arrays["rig_name"], kind="text", shape=()))
    return _clip(path, arrays, name, None, fps)


def _clip(
    path: Path, arrays: dict[str, np.ndarray], rig_name: str, n_expressions: int | None, fps: float | None
) -> Clip:
    expr = checked_float32(path, "expr", arrays.get("expr"), shape=(None, n_expressions))
    frames = len(expr)
    if not 1 <= frames <= MAX_FRAMES:
        raise DataError(path, "expr", expected=f"1 to {MAX_FRAMES} frames", found=frames)
    zeros = np.zeros((frames, 3), np.float32)
    turns = {name: zeros for name in ("neck_rot", "jaw_rot") if name not in arrays}
    pose = {name: None for name in ("rot", "tra") if not {"rot", "tra"} <= arrays.keys()}
    for name in {"eye_rot", "neck_rot", "jaw_rot", "rot", "tra"} - turns.keys() - pose.keys():
        turns[name] = checked_float32(path, name, arrays.get(name), shape=(frames, 3))
    return Clip(rig_name, fps or _fps(path, arrays), expr, **turns, **pose)


def _check_rig(path: Path, arrays: dict[str, np.ndarray], bundle: Bundle) -> None:
    if "rig_name" not in arrays:
        if bundle.rig_name != RELEASED_RIG:
            found = f"none, so {RELEASED_RIG!r}"
            raise DataError(path, "rig_name", expected=repr(bundle.rig_name), found=found)
        return
    name = str(checked(path, "rig_name", arrays["rig_name"], kind="text", shape=()))
    if name != bundle.rig_name:
        raise DataError(path, "rig_name", expected=repr(bundle.rig_name), found=repr(name[:64]))


def _fps(path: Path, arrays: dict[str, np.ndarray]) -> float:
    value = arrays.get("fps")
    if value is None:
        return DEFAULT_FPS
    if value.size != 1 or value.dtype.kind not in "fiu" or not 0 < float(value.reshape(())) <= 1000:
        raise DataError(
            path, "fps", expected="one number in (0, 1000]", found=f"{value.dtype}{list(value.shape)}"
        )
    return float(value.reshape(()))
