"""Apple's 52 blendshapes, and how a rig shows them.

A rig that names its expressions after them shows them exactly; what it lacks is left out. FLAME names none:
there they are solved for, see arkit_flame.py. Left and right are the person's own.

| rig | how | of the 52 it lacks |
|---|---|---|
| `builtin` | by name | none |
| `ict_facekit_light` | by name; `browInnerUp` and `cheekPuff` drive both sides' shapes | `tongueOut` |
| FLAME | solved on its own expressions, and `jaw_rot` where it has a jaw | `tongueOut` |

Gaze is not a blendshape of any rig: eye joints turn by the eight `eyeLook` weights (whose shapes only move
the lids).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.errors import ArgumentError

NAMES = (
    *("eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft"),
    *("eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight"),
    *("eyeLookUpRight", "eyeSquintRight", "eyeWideRight", "jawForward", "jawLeft", "jawRight", "jawOpen"),
    *("mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight", "mouthSmileLeft"),
    *("mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight"),
    *("mouthStretchLeft", "mouthStretchRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower"),
    *("mouthShrugUpper", "mouthPressLeft", "mouthPressRight", "mouthLowerDownLeft", "mouthLowerDownRight"),
    *("mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft", "browDownRight", "browInnerUp"),
    *("browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft", "cheekSquintRight"),
    *("noseSneerLeft", "noseSneerRight", "tongueOut"),
)
"""Apple's order (`ARFaceAnchor.BlendShapeLocation`), which is also that of Live Link Face's packets."""
COLUMN = {name: column for column, name in enumerate(NAMES)}

# How far an eye turns at a weight of 1. Measured on the app's own recordings, which hold the weights beside
# the angles: 35.0 degrees inwards, outwards and down, 25.1 up.
LOOK_FAR, LOOK_UP = np.float32(np.radians(35.0)), np.float32(np.radians(25.0))


@dataclass(frozen=True, eq=False)
class ArkitMap:
    """The 52 weights -> one rig.

    Args:
        rig_name: Whose expressions they become.
        expr: float32[E, 52] expressions per weight.
        jaw_rot: float32[3, 52] rad per weight; zero where expressions alone open the jaw.
        missing: Names that the rig cannot show; their weights do nothing (`eyeLook*` still turn the eyes).
        error_mm: float32[52] how far the rig's shape is from the one asked for, root mean square over the
            points that this moves at all; 0 where it is the rig's own.
        rest: float32[52] the weights that the rig's neutral face stands at: 0, but for FLAME's jaw in an
            edition whose neutral mouth is open; None is 0.
    """

    rig_name: str
    expr: np.ndarray
    jaw_rot: np.ndarray
    missing: tuple[str, ...]
    error_mm: np.ndarray
    rest: np.ndarray | None = None

    def __call__(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """float32 [..., 52] -> expr [..., E], eye_rot [..., 3], jaw_rot [..., 3] rad."""
        eye_rot = gaze_of(weights)
        weights = weights if self.rest is None else weights - self.rest
        return weights @ self.expr.T, eye_rot, weights @ self.jaw_rot.T


def arkit_map(bundle: Bundle) -> ArkitMap:
    """The map of an avatar's rig.

    Raises:
        ArgumentError: The rig names none of the 52 and is no FLAME.
    """
    by_name = _by_name(bundle.rig_name, bundle.subject.expression_names)
    if by_name is not None:
        return by_name
    if bundle.rig_name.startswith("flame"):
        from cap4d.drive.arkit_flame import arkit_on_flame  # which knows this file's names

        return arkit_on_flame(bundle)
    raise ArgumentError(
        f"arkit: expected an avatar on a rig with ARKit's expressions or on FLAME, got {bundle.rig_name}"
    )


def gaze_of(weights: np.ndarray) -> np.ndarray:
    """float32[..., 3] rad, the one rotation of both eyes that the `eyeLook` weights [..., 52] ask for.

    The mean of the two eyes': what they do against each other (squinting, looking at something near) is lost.
    """
    look = lambda part: weights[..., COLUMN[f"eyeLook{part}"]]  # noqa: E731
    left = look("OutLeft") + look("InRight") - look("InLeft") - look("OutRight")
    down, up = look("DownLeft") + look("DownRight"), look("UpLeft") + look("UpRight")
    turn = np.stack([LOOK_FAR * down - LOOK_UP * up, LOOK_FAR * left, 0 * left], -1) / 2
    return turn.astype(np.float32)


def look_weights(eye_rot: np.ndarray) -> np.ndarray:
    """float32[52] the `eyeLook` weights that turn both eyes by `eye_rot` [3] rad: `gaze_of`'s inverse."""
    weights = np.zeros(len(NAMES), np.float32)
    pitch, yaw = float(eye_rot[0]), float(eye_rot[1])
    vertical = ("Down", pitch / LOOK_FAR) if pitch > 0 else ("Up", -pitch / LOOK_UP)
    sides = ("OutLeft", "InRight") if yaw > 0 else ("InLeft", "OutRight")
    for part in (f"{vertical[0]}Left", f"{vertical[0]}Right"):
        weights[COLUMN[f"eyeLook{part}"]] = vertical[1]
    for part in sides:
        weights[COLUMN[f"eyeLook{part}"]] = abs(yaw) / LOOK_FAR
    return weights


def apple_name(name: str) -> str | None:
    """Apple's name of a rig's `eyeBlink_L`, `jawOpen` or `browInnerUp_R` (a half of Apple's), or None."""
    if name in COLUMN:
        return name
    stem, _, side = name.rpartition("_")
    whole = stem + {"L": "Left", "R": "Right"}.get(side, "?")
    return whole if whole in COLUMN else stem if stem in COLUMN and side in ("L", "R") else None


def _by_name(rig_name: str, names: tuple[str, ...]) -> ArkitMap | None:
    expr = np.zeros((len(names), len(NAMES)), np.float32)
    for row, name in enumerate(names):
        apple = apple_name(name)
        if apple is not None:
            expr[row, COLUMN[apple]] = 1
    if not expr.any():
        return None
    missing = tuple(name for name, column in zip(NAMES, expr.T, strict=True) if not column.any())
    return ArkitMap(
        rig_name, expr, np.zeros((3, len(NAMES)), np.float32), missing, np.zeros(len(NAMES), np.float32)
    )
