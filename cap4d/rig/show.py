"""A picture of a whole rig: its neutral head from three sides, its first identity modes, each of its
expressions.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cap4d.camera import Camera, opencv_from_rig, orbit_camera
from cap4d.mesh import shade
from cap4d.rig.head import HeadRig

log = logging.getLogger(__name__)

TILE = 176  # px, a side of one picture
COLUMNS = 9
IDENTITY_MODES = 9
STRENGTH = 2.0  # of an identity mode, in standard deviations
FOV_DEG = 14.0
TURNS = {"front": 0, "three-quarter": 40, "side": 90, "back": 180}  # of the camera, degrees
PROGRESS_SECONDS = 2.0
MARGIN = 1.12  # of the view around the head

# 5 x 7 letters: the letter, then seven rows of five bits, top row first, two hexadecimal digits a row.
_FONT = """
    A0E11111F111111 B1E11111E11111E C0E11101010110E D1E11111111111E E1F10101E10101F F1F10101E101010
    G0E11101711110F H1111111F111111 I0E04040404040E J0702020202120C K11121418141211 L1010101010101F
    M111B1515111111 N11191513111111 O0E11111111110E P1E11111E101010 Q0E11111115120D R1E11111E141211
    S0F10100E01011E T1F040404040404 U1111111111110E V11111111110A04 W1111111515150A X11110A040A1111
    Y11110A04040404 Z1F01020408101F 00E11131519110E 1040C040404040E 20E11010204081F 31F02040201110E
    402060A121F0202 51F101E0101110E 60608101E11110E 71F010204080808 80E11110E11110E 90E11110F01020C
    +0004041F040400 -0000001F000000 .00000000000C0C _0000000000001F
"""
LETTERS = {entry[0]: bytes.fromhex(entry[1:]) for entry in _FONT.split()} | {" ": bytes(7)}


def contact_sheet(rig: HeadRig, path: Path) -> None:
    """Writes a PNG sheet of labelled pictures; expressions are shown at the top of their range, from a little
    aside.
    """
    from cap4d.player.png import write_png

    total = len(TURNS) + 2 + 2 * min(IDENTITY_MODES, rig.n_identity) + rig.n_expressions
    tiles, start, reported = [], time.monotonic(), 0.0
    for name, picture in pictures(rig):
        tiles.append(label(picture, name))
        seconds = time.monotonic() - start
        if seconds - reported > PROGRESS_SECONDS:
            reported = seconds
            left = seconds / len(tiles) * (total - len(tiles))
            log.info("%d of %d pictures, %.0f s left", len(tiles), total, left)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[i : i + COLUMNS], 1) for i in range(0, len(tiles), COLUMNS)]
    write_png(Path(path), np.concatenate(rows, 0))


def pictures(rig: HeadRig) -> Iterator[tuple[str, np.ndarray]]:
    """Name and uint8[TILE, TILE, 3] of each picture of the sheet."""
    rest = np.zeros(rig.n_expressions, np.float32)
    neutral = rig.subject()
    for name, yaw_deg in TURNS.items():
        yield name, draw(rig, neutral.pose(rest), yaw_deg=yaw_deg)
    turn = np.float32([-0.2, 0.4, 0])
    yield "eyes turned", draw(rig, neutral.pose(rest, eye_rot=turn))
    yield "neck bent", draw(rig, neutral.pose(rest, neck_rot=turn))
    for mode in range(min(IDENTITY_MODES, rig.n_identity)):
        for amount in (-STRENGTH, STRENGTH):
            shape = np.zeros(rig.n_identity, np.float32)
            shape[mode] = amount
            yield f"identity{mode} {amount:+.0f}", draw(rig, rig.subject(shape).pose(rest), yaw_deg=20)
    for index, name in enumerate(rig.expression_names):
        expr = rest.copy()
        expr[index] = rig.expression_range[index, 1]
        yield name, draw(rig, neutral.pose(expr), yaw_deg=20)


def draw(rig: HeadRig, vertices: np.ndarray, *, yaw_deg: float = 0.0) -> np.ndarray:
    """uint8[TILE, TILE, 3] shaded picture of posed vertices [V, 3], on white, framed by the rig's neutral
    head.
    """
    rgba = shade(opencv_from_rig(vertices), rig.faces, head_camera(rig, yaw_deg), colors=rig.colors)
    return np.round(255 * (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])).astype(np.uint8)


def head_camera(rig: HeadRig, yaw_deg: float = 0.0, size: int = TILE) -> Camera:
    """A camera that sees the rig's neutral head, without shoulders, filling a square picture."""
    head = opencv_from_rig(rig.template[rig.regions["head"]].astype(np.float64))
    centre = (head.min(0) + head.max(0)) / 2
    radius = np.ptp(head[:, 1]) / 2 * MARGIN
    distance = radius / np.tan(np.radians(FOV_DEG) / 2)
    return orbit_camera(
        yaw_deg=yaw_deg,
        pitch_deg=0,
        distance=distance,
        target=centre,
        fov_y_deg=FOV_DEG,
        width=size,
        height=size,
    )


def label(picture: np.ndarray, text: str) -> np.ndarray:
    """The picture with a line of text above it, in capitals; what does not fit is cut off."""
    strip = np.full((11, picture.shape[1], 3), 255, np.uint8)
    for index, letter in enumerate(text.upper()[: (picture.shape[1] - 4) // 6]):
        rows = np.frombuffer(LETTERS.get(letter, LETTERS["-"]), np.uint8)
        bits = np.unpackbits(rows[:, None], axis=1)[:, 3:]
        strip[2:9, 4 + 6 * index : 9 + 6 * index][bits == 1] = 0
    return np.concatenate([strip, picture], 0)
