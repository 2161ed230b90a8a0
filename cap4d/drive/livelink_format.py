"""A packet of Live Link Face, version 6, as the phone sends it: big-endian.

u8 6 | u32 length, device id | u32 length, subject name | i32 frame, f32 part of a frame, i32 rate, i32 per
u8 61 | f32[61]: ARKit's 52 weights, then yaw, pitch and roll of the head, the left and the right eye
"""

from __future__ import annotations

import struct

import numpy as np

from cap4d.drive.packet import Packet

VERSION = 6
VALUES, ANGLES = 61, 9
RATE = 60  # frames a second of the time code


def format_livelink(packet: Packet, *, device: str = "cap4d", subject: str = "cap4d") -> bytes:
    """The packet of `arkit` weights. The angles are zero: gaze is in the weights."""
    position = packet.t * RATE
    frame = int(np.floor(position))
    words = b"".join(struct.pack(">I", len(word)) + word for word in (device.encode(), subject.encode()))
    time = struct.pack(">ifii", frame, position - frame, RATE, 1)
    values = np.concatenate([packet.arkit, np.zeros(ANGLES)]).astype(">f4").tobytes()
    return struct.pack(">B", VERSION) + words + time + struct.pack(">B", VALUES) + values
