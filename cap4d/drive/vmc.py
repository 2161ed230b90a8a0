"""VMC, the protocol of programs that animate VRM characters (OSC over UDP; protocol.vmc.info).

    /VMC/Ext/Blend/Val  name weight          a shape; kept until it is said anew
    /VMC/Ext/Blend/Apply                     what has been said is a frame
    /VMC/Ext/Bone/Pos   name x y z qx qy qz qw   `Head`, `Neck`, `LeftEye`, `RightEye`: others are left aside
    /VMC/Ext/T          seconds              the sender's clock, where it has one

Shapes are Apple's 52 by name ("perfect sync"; capitals do not matter), or, of senders who have none of these,
VRM's presets, each as an everyday mixture of Apple's.
"""

from __future__ import annotations

import numpy as np

from cap4d.drive.arkit import COLUMN, NAMES
from cap4d.drive.datagrams import DatagramReceiver
from cap4d.drive.head_turn import head_pose
from cap4d.drive.osc import parse_osc
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.rotation import quat_to_rotmat, rotmat_to_axis_angle

BLEND, APPLY, BONE, TIME = "/VMC/Ext/Blend/Val", "/VMC/Ext/Blend/Apply", "/VMC/Ext/Bone/Pos", "/VMC/Ext/T"
MAX_RATE = 10_000.0  # datagrams a second: many programs send each message, some 60 a frame, by itself
MAX_WEIGHT = 2.0  # of weights that are 0 to 1
CLOCK_SECONDS = 0.5  # to wait for a sender's clock, before frames bear the time they come at
BONES = ("Neck", "Head", "LeftEye", "RightEye")


def _both(stem: str, weight: float) -> dict[str, float]:
    return {stem + "Left": weight, stem + "Right": weight}


_PRESETS = {
    ("a", "aa"): {"jawOpen": 0.6},
    ("i", "ih"): {"jawOpen": 0.15, **_both("mouthStretch", 0.4)},
    ("u", "ou"): {"jawOpen": 0.15, "mouthPucker": 0.7},
    ("e", "ee"): {"jawOpen": 0.25, **_both("mouthStretch", 0.3), **_both("mouthSmile", 0.2)},
    ("o", "oh"): {"jawOpen": 0.35, "mouthFunnel": 0.7},
    ("joy", "happy", "fun"): {**_both("mouthSmile", 0.8), **_both("cheekSquint", 0.5)},
    ("relaxed",): _both("mouthSmile", 0.3),
    ("angry",): {**_both("browDown", 0.8), **_both("mouthFrown", 0.3), **_both("noseSneer", 0.2)},
    ("sorrow", "sad"): {"browInnerUp": 0.7, **_both("mouthFrown", 0.6)},
    ("surprised",): {
        "jawOpen": 0.2,
        "browInnerUp": 0.6,
        **_both("browOuterUp", 0.6),
        **_both("eyeWide", 0.7),
    },
    ("blink",): _both("eyeBlink", 1.0),
    ("blink_l", "blinkleft"): {"eyeBlinkLeft": 1.0},
    ("blink_r", "blinkright"): {"eyeBlinkRight": 1.0},
    ("lookup",): _both("eyeLookUp", 1.0),
    ("lookdown",): _both("eyeLookDown", 1.0),
    ("lookleft",): {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
    ("lookright",): {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0},
}
APPLES = {name.lower(): name for name in NAMES}
PRESETS = {name: shapes for names, shapes in _PRESETS.items() for name in names}
"""VRM 0's and VRM 1's names in small letters -> Apple's, by weight."""


class VmcReceiver(DatagramReceiver):
    """Listens for such a program; see `packet.Receiver`. Other arguments: see `DatagramReceiver`."""

    def __init__(self, host: str, port: int, sender: str | None = None, **keywords) -> None:
        super().__init__("vmc", host, port, sender=sender, parser=VmcParser, rate=MAX_RATE, **keywords)


class VmcParser:
    """What one sender has said so far; see `datagrams.Parser`."""

    def __init__(self) -> None:
        self._apples: dict[str, float] = {}
        self._presets: dict[str, float] = {}
        self._bones: dict[str, np.ndarray] = {}
        self._time: float | None = None
        self._first: float | None = None
        self._own_clock: bool | None = None  # None: not known yet

    def __call__(self, data: bytes, arrival: float) -> list[Packet]:
        """The frames that a datagram applies.

        Raises:
            Rejected: SYNTAX, SIZE, FIELD or NOT_FINITE; of a datagram with several messages those before the
                bad one count.
        """
        packets = []
        for address, values in parse_osc(data):
            if address == BLEND:
                self._blend(values)
            elif address == BONE:
                self._bone(values)
            elif address == TIME:
                self._time = _floats(values, 1)[0]
            elif address == APPLY and (t := self._stamp(arrival)) is not None:
                packets.append(self._packet(t))
        return packets

    def _blend(self, values: list) -> None:
        name, weight = _text(values), _floats(values[1:], 1)[0]
        small, weight = name.lower(), min(max(weight, -MAX_WEIGHT), MAX_WEIGHT)
        if small in APPLES:
            self._apples[APPLES[small]] = weight
        elif small in PRESETS:
            self._presets[small] = weight

    def _bone(self, values: list) -> None:
        name = _text(values)
        if name in BONES:
            x, y, z, w = _floats(values[1:], 7)[3:]
            if abs(x * x + y * y + z * z + w * w - 1) > 0.1:
                raise Rejected(Cause.FIELD, f"{name}: expected a unit quaternion")
            # Unity's axes are left-handed, x to the character's right: mirrored, they are the rig's.
            self._bones[name] = np.array([w, x, -y, -z])

    def _stamp(self, arrival: float) -> float | None:
        """The frame's time; None while it is not known whether the sender has a clock."""
        self._first = arrival if self._first is None else self._first
        if self._own_clock is None:
            if self._time is not None:
                self._own_clock = True
            elif arrival - self._first >= CLOCK_SECONDS:
                self._own_clock = False
            else:
                return None
        return self._time if self._own_clock else arrival

    def _packet(self, t: float) -> Packet:
        weights = np.zeros(len(NAMES), np.float32)
        shapes = [({name: 1.0}, weight) for name, weight in self._apples.items()]
        if not shapes:
            shapes = [(PRESETS[name], weight) for name, weight in self._presets.items()]
        for mixture, weight in shapes:
            for name, share in mixture.items():
                weights[COLUMN[name]] += share * weight
        return Packet(t, arkit=weights, **self._pose())

    def _pose(self) -> dict[str, np.ndarray]:
        found = {}
        turns = {name: quat_to_rotmat(quat) for name, quat in self._bones.items()}
        if turns.keys() & {"Neck", "Head"}:
            head = turns.get("Neck", np.eye(3)) @ turns.get("Head", np.eye(3))
            found |= head_pose(rotmat_to_axis_angle(head).astype(np.float32))
        eyes = [rotmat_to_axis_angle(turns[name]) for name in ("LeftEye", "RightEye") if name in turns]
        if eyes and np.abs(eyes).max() > 1e-6:  # a sender with gaze in its weights leaves the bones straight
            found["eye_rot"] = np.mean(eyes, 0).astype(np.float32)
        return found


def _text(values: list) -> str:
    if not values or not isinstance(values[0], str):
        raise Rejected(Cause.FIELD, "expected a name first")
    return values[0]


def _floats(values: list, count: int) -> list[float]:
    """The numbers, finite in float32."""
    if len(values) < count or not all(type(value) in (int, float) for value in values[:count]):
        raise Rejected(Cause.FIELD, f"expected {count} numbers")
    found = [float(value) for value in values[:count]]
    if not all(abs(value) < 3e38 for value in found):  # nor is what is not a number
        raise Rejected(Cause.NOT_FINITE, "expected finite numbers")
    return found
