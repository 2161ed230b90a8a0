"""Live Link Face, Epic's app for phones: its packets over UDP, version 6. Its recordings: livelink_csv.py.

A packet is big-endian:

    u8 6 | u32 length, device id | u32 length, subject's name | i32 frame, f32 part of it, i32 rate, i32 per
    u8 61 | f32[61]: the 52 weights in Apple's order, then yaw, pitch and roll of the head, left and right eye

Without a face it ends after the name, or after the time, or counts no values. Angles are in radians; the
signs are those of the app's own recordings, which hold each eye's angles beside its weights: positive pitch
looks down, positive yaw to the person's right. Zeros are an app that was told not to send them.
"""

from __future__ import annotations

import struct

import numpy as np

from cap4d.drive.arkit import NAMES
from cap4d.drive.datagrams import DatagramReceiver
from cap4d.drive.head_turn import head_pose, turn
from cap4d.drive.packet import Cause, Packet, Rejected

VERSION = 6
ANGLES = (
    *("HeadYaw", "HeadPitch", "HeadRoll"),
    *("LeftEyeYaw", "LeftEyePitch", "LeftEyeRoll", "RightEyeYaw", "RightEyePitch", "RightEyeRoll"),
)
VALUES = len(NAMES) + len(ANGLES)
MAX_NAME = 256  # bytes
MAX_PACKET = 1 + 2 * (4 + MAX_NAME) + 16 + 1 + 4 * VALUES
TIME = struct.Struct(">ifii")
MAX_RATE = 1000.0  # frames a second


class LiveLinkReceiver(DatagramReceiver):
    """Listens for the app; see `packet.Receiver`. Other arguments: see `DatagramReceiver`."""

    def __init__(self, host: str, port: int, sender: str | None = None, **keywords) -> None:
        super().__init__("livelink", host, port, sender=sender, parser=lambda: _parse, **keywords)


def parse_livelink(data: bytes) -> Packet | None:
    """A packet's frame; None: the app sees no face.

    Raises:
        Rejected: SIZE, SYNTAX, SHAPE, NOT_FINITE or TIME.
    """
    if len(data) > MAX_PACKET:
        raise Rejected(Cause.SIZE, f"expected at most {MAX_PACKET} bytes, got {len(data)}")
    if data[:1] != bytes([VERSION]):
        raise Rejected(Cause.SYNTAX, f"expected version {VERSION} of Live Link Face, got {data[:1].hex()}")
    at = _skip_text(data, _skip_text(data, 1))
    if at == len(data):
        return None
    t, at = _time(data, at), at + TIME.size
    count = data[at] if at < len(data) else 0
    if count == 0 and len(data) <= at + 1:
        return None
    if count != VALUES or len(data) != at + 1 + 4 * VALUES:
        raise Rejected(Cause.SHAPE, f"expected {VALUES} values, got {count} in {len(data) - at - 1} bytes")
    values = np.frombuffer(data, ">f4", VALUES, at + 1).astype(np.float32)
    if not np.isfinite(values).all():
        raise Rejected(Cause.NOT_FINITE, "expected finite values")
    return Packet(t, arkit=values[: len(NAMES)].copy(), **pose_of_angles(values[len(NAMES) :]))


def pose_of_angles(angles: np.ndarray) -> dict[str, np.ndarray]:
    """The app's nine angles [..., 9] rad -> `rot`, `tra`, `neck_rot` and `eye_rot`, as far as there are any.

    Both eyes turn alike, by their mean.
    """
    found = {}
    head, eyes = angles[..., :3], (angles[..., 3:6] + angles[..., 6:9]) / 2
    if head.any():
        found |= head_pose(turn(-head[..., 0], head[..., 1], -head[..., 2]))
    if eyes.any():
        found["eye_rot"] = turn(-eyes[..., 0], eyes[..., 1])
    return found


def _parse(data: bytes, _arrival: float) -> list[Packet]:
    packet = parse_livelink(data)
    return [] if packet is None else [packet]


def _skip_text(data: bytes, at: int) -> int:
    """Where what follows a length and its bytes begins."""
    if len(data) < at + 4:
        raise Rejected(Cause.SYNTAX, "cut short within a name's length")
    length = int.from_bytes(data[at : at + 4], "big")
    if length > MAX_NAME or at + 4 + length > len(data):
        raise Rejected(Cause.SYNTAX, f"expected a name of at most {MAX_NAME} bytes, got {length}")
    return at + 4 + length


def _time(data: bytes, at: int) -> float:
    """Seconds."""
    if len(data) < at + TIME.size:
        raise Rejected(Cause.SYNTAX, "cut short within the time")
    frame, part, rate, per = TIME.unpack_from(data, at)
    if not (frame >= 0 and -1 <= part <= 1 and per > 0 and 0 < rate <= MAX_RATE * per):
        raise Rejected(Cause.TIME, f"expected a time code, got frame {frame} + {part} at {rate} / {per}")
    return (frame + part) * per / rate
