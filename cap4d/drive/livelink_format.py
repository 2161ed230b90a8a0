"""A packet of Live Link Face, as the app sends it: what `livelink.parse_livelink` reads, the other way."""

from __future__ import annotations

import struct

import numpy as np

from cap4d.drive.livelink import TIME, VALUES, VERSION
from cap4d.drive.packet import Packet
from cap4d.rotation import axis_angle_to_rotmat

RATE = 60  # frames a second of the time code
DAY = 24 * 3600.0  # s, after which time codes start again


def format_livelink(packet: Packet, *, device: str = "cap4d", subject: str = "cap4d") -> bytes:
    """The packet of `arkit` weights, gaze, and how the head turns, where it has no place (`tra`) besides."""
    position = packet.t % DAY * RATE
    frame = int(np.floor(position))
    words = b"".join(struct.pack(">I", len(word)) + word for word in (device.encode(), subject.encode()))
    values = np.concatenate([packet.arkit, angles_of_pose(packet)]).astype(">f4").tobytes()
    time = TIME.pack(frame, position - frame, RATE, 1)
    return struct.pack(">B", VERSION) + words + time + struct.pack(">B", VALUES) + values


def angles_of_pose(packet: Packet) -> np.ndarray:
    """[9] rad, the app's yaw, pitch and roll of the head and of both eyes; see `livelink.pose_of_angles`."""
    turns = packet.rot is not None and (packet.tra is None or not packet.tra.any())
    head = _angles(packet.rot) if turns else np.zeros(3)
    eyes = np.zeros(3) if packet.eye_rot is None else _angles(packet.eye_rot) * [1, 1, 0]
    return np.concatenate([head, eyes, eyes])


def _angles(rot: np.ndarray) -> np.ndarray:
    """Axis-angle -> (yaw, pitch, roll) whose `head_turn.turn(-yaw, pitch, -roll)` it is."""
    matrix = axis_angle_to_rotmat(np.asarray(rot, np.float64))
    pitch = np.arcsin(np.clip(-matrix[1, 2], -1, 1))
    yaw, roll = np.arctan2(matrix[0, 2], matrix[2, 2]), np.arctan2(matrix[1, 0], matrix[1, 1])
    return np.array([-yaw, pitch, -roll])
