"""VMC over OSC: shapes, bones and a clock, and datagrams that are none of it."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from cap4d.drive.arkit import COLUMN, NAMES
from cap4d.drive.osc import MAX_DEPTH, MAX_MESSAGES, parse_osc
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.drive.vmc import CLOCK_SECONDS, PRESETS, VmcParser, VmcReceiver
from cap4d.rotation import axis_angle_to_rotmat


def text(value: str) -> bytes:
    data = value.encode() + b"\0"
    return data + b"\0" * (-len(data) % 4)


def message(address: str, *values: float | str) -> bytes:
    tags = "," + "".join("s" if isinstance(value, str) else "f" for value in values)
    parts = [text(value) if isinstance(value, str) else struct.pack(">f", value) for value in values]
    return text(address) + text(tags) + b"".join(parts)


def bundle(*elements: bytes) -> bytes:
    return b"#bundle\0" + bytes(7) + b"\1" + b"".join(struct.pack(">i", len(e)) + e for e in elements)


def blend(**weights: float) -> list[bytes]:
    return [message("/VMC/Ext/Blend/Val", name, weight) for name, weight in weights.items()]


def bone(name: str, *quat_xyzw: float) -> bytes:
    return message("/VMC/Ext/Bone/Pos", name, 0, 0, 0, *quat_xyzw)


APPLY = message("/VMC/Ext/Blend/Apply")


def clock(t: float) -> bytes:
    return message("/VMC/Ext/T", t)


def only(packets: list[Packet]) -> Packet:
    assert len(packets) == 1
    return packets[0]


def shown(packet: Packet) -> dict[str, float]:
    return {NAMES[i]: round(float(packet.arkit[i]), 5) for i in np.flatnonzero(packet.arkit)}


def test_perfect_sync_in_a_bundle() -> None:
    """Capitals differ from program to program."""
    data = bundle(clock(12.5), *blend(JawOpen=0.5, eyeBlinkLeft=1, MOUTHSMILERIGHT=0.25, Unknown=1), APPLY)
    found = only(VmcParser()(data, 99.0))
    assert found.t == 12.5 and shown(found) == {"jawOpen": 0.5, "eyeBlinkLeft": 1, "mouthSmileRight": 0.25}
    assert found.rot is None and found.eye_rot is None and found.expr is None


def test_messages_one_a_datagram_and_shapes_that_stay() -> None:
    parse = VmcParser()
    assert parse(clock(1.0), 0) == [] and parse(blend(JawOpen=0.5)[0], 0) == []
    assert shown(only(parse(APPLY, 0))) == {"jawOpen": 0.5}
    parse(blend(BrowInnerUp=0.2)[0], 0)
    parse(clock(1.1), 0)
    second = only(parse(APPLY, 0))
    assert second.t == pytest.approx(1.1) and shown(second) == {"jawOpen": 0.5, "browInnerUp": 0.2}


def test_a_sender_without_a_clock_gets_ours_once_that_is_known() -> None:
    parse = VmcParser()
    assert parse(APPLY, 10.0) == [] and parse(APPLY, 10.0 + CLOCK_SECONDS / 2) == []
    assert only(parse(APPLY, 11.0)).t == 11.0
    assert only(parse(bundle(clock(3.0), APPLY), 12.0)).t == 12.0, "and keeps it: one clock"


def test_presets_of_who_has_no_perfect_sync() -> None:
    found = only(VmcParser()(bundle(clock(0), *blend(A=1, Blink_L=0.5, LookLeft=1), APPLY), 0))
    assert shown(found) == {"jawOpen": 0.6, "eyeBlinkLeft": 0.5, "eyeLookOutLeft": 1, "eyeLookInRight": 1}
    both = only(VmcParser()(bundle(clock(0), *blend(A=1, JawOpen=0.1), APPLY), 0))
    assert shown(both) == {"jawOpen": pytest.approx(0.1)}, "who has it sends the presets beside it"
    assert all(name in COLUMN and 0 < share <= 1 for mix in PRESETS.values() for name, share in mix.items())
    assert {"a", "i", "u", "e", "o", "aa", "ih", "ou", "ee", "oh", "joy", "happy", "blink"} <= PRESETS.keys()


def test_the_head_turns_as_the_character_does() -> None:
    """Unity: left-handed, the character faces +z, x to its right; a positive turn about y is to its right."""
    turn, nod = np.sin(0.15), np.sin(0.1)
    left = only(VmcParser()(bundle(clock(0), bone("Head", 0, -turn, 0, np.cos(0.15)), APPLY), 0))
    assert np.allclose(left.rot, [0, 0.3, 0], atol=1e-6), "the rig's +x is the person's left"
    assert np.array_equal(left.neck_rot, -left.rot) and not left.tra.any()
    both = bundle(
        *(clock(0), bone("Neck", 0, -turn, 0, np.cos(0.15)), bone("Head", nod, 0, 0, np.cos(0.1))), APPLY
    )
    nose = axis_angle_to_rotmat(only(VmcParser()(both, 0)).rot.astype(float)) @ [0, 0, 1]
    assert nose[0] > 0.25 and nose[1] < -0.15, "left by the neck, then down by the head"


def test_eyes_by_bones_when_these_turn() -> None:
    straight = bundle(clock(0), bone("LeftEye", 0, 0, 0, 1), bone("RightEye", 0, 0, 0, 1), APPLY)
    assert only(VmcParser()(straight, 0)).eye_rot is None
    down = [bone(name, np.sin(0.1), 0, 0, np.cos(0.1)) for name in ("LeftEye", "RightEye")]
    assert np.allclose(only(VmcParser()(bundle(clock(0), *down, APPLY), 0)).eye_rot, [0.2, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", Cause.SYNTAX),
        (b"garbage", Cause.SYNTAX),
        (b"no slash\0\0\0\0,\0\0\0", Cause.SYNTAX),
        (b"#bundle\0", Cause.SYNTAX),
        (bundle(APPLY)[:-1], Cause.SYNTAX),
        (bundle() + struct.pack(">i", -4), Cause.SYNTAX),  # a parser that believes it never ends
        (bundle() + struct.pack(">i", 0) * 4, Cause.SYNTAX),
        (bundle() + struct.pack(">i", 2**31 - 1), Cause.SYNTAX),
        (text("/VMC/Ext/T") + text("f") + struct.pack(">f", 1), Cause.SYNTAX),
        (text("/VMC/Ext/T") + text(",f"), Cause.SYNTAX),
        (text("/VMC/Ext/T") + text(",b") + bytes(4), Cause.SYNTAX),
        (text("/VMC/Ext/Blend/Val") + text(",sf") + b"endless", Cause.SYNTAX),
        (message("/VMC/Ext/Blend/Val"), Cause.FIELD),
        (message("/VMC/Ext/Blend/Val", 1.0, 2.0), Cause.FIELD),
        (message("/VMC/Ext/Blend/Val", "A"), Cause.FIELD),
        (message("/VMC/Ext/Blend/Val", "A", "B"), Cause.FIELD),
        (message("/VMC/Ext/Blend/Val", "A", float("nan")), Cause.NOT_FINITE),
        (message("/VMC/Ext/T", float("inf")), Cause.NOT_FINITE),
        (bone("Head", 0, 0, 0, 0), Cause.FIELD),
        (bone("Head", 1e38, 1e38, 0, 0), Cause.FIELD),
        (bone("Head", float("nan"), 0, 0, 1), Cause.NOT_FINITE),
        (message("/VMC/Ext/Bone/Pos", "Head", 0.0), Cause.FIELD),
        (bundle(*[APPLY] * (MAX_MESSAGES + 1)), Cause.SIZE),
    ],
)
def test_what_is_none_of_it_is_refused_with_its_cause(data: bytes, cause: Cause) -> None:
    with pytest.raises(Rejected) as caught:
        VmcParser()(data, 0)
    assert caught.value.cause == cause


def test_bundles_nest_but_not_for_ever() -> None:
    data = APPLY
    for _ in range(MAX_DEPTH):
        data = bundle(data)
    assert parse_osc(data) == [("/VMC/Ext/Blend/Apply", [])]
    with pytest.raises(Rejected, match="deep"):
        parse_osc(bundle(data))


def test_other_messages_are_nobodys_business() -> None:
    others = [
        message("/VMC/Ext/Root/Pos", "root", *[0.0] * 7),
        message("/VMC/Ext/OK", 1.0),
        bone("Hips", 0, 0, 0, 0),
    ]
    assert shown(only(VmcParser()(bundle(clock(0), *others, APPLY), 0))) == {}


def test_weights_beyond_sense_stay_finite() -> None:
    data = bundle(clock(0), *blend(JawOpen=1e38, MouthClose=-1e38), APPLY)
    assert np.abs(only(VmcParser()(data, 0)).arkit).max() == 2


def test_flipped_bits_raise_nothing_else() -> None:
    rng = np.random.default_rng(0)
    whole = bundle(clock(1), *blend(JawOpen=0.5, A=1), bone("Head", 0, 0, 0, 1), bundle(APPLY))
    for _ in range(4000):
        data = bytearray(whole[: rng.integers(len(whole) + 1)])
        for at in rng.integers(0, max(len(data), 1), 3 if data else 0):
            data[at] = rng.integers(256)
        try:
            for packet in VmcParser()(bytes(data), 0):
                assert np.isfinite(packet.arkit).all() and np.isfinite(packet.t)
        except Rejected:
            pass


def test_as_python_osc_writes_it() -> None:
    """Against another implementation of OSC, where it is installed."""
    builders = pytest.importorskip("pythonosc.osc_bundle_builder")
    from pythonosc.osc_message_builder import OscMessageBuilder

    made = builders.OscBundleBuilder(builders.IMMEDIATELY)
    for address, values in (
        ("/VMC/Ext/T", [2.5]),
        ("/VMC/Ext/Blend/Val", ["JawOpen", 0.5]),
        ("/VMC/Ext/Blend/Apply", []),
    ):
        one = OscMessageBuilder(address)
        for value in values:
            one.add_arg(value)
        made.add_content(one.build())
    found = only(VmcParser()(made.build().dgram, 0))
    assert found.t == 2.5 and shown(found) == {"jawOpen": 0.5}


def test_the_receiver_forgets_a_sender_who_left() -> None:
    now = [0.0]
    receiver, packets = VmcReceiver("127.0.0.1", 0, clock=lambda: now[0]), []

    class Sink:
        def packet(self, packet: Packet, arrival: float) -> bool:
            packets.append(packet)
            return True

        def rejected(self, cause: Cause, detail: str = "", *, times: int = 1) -> None:
            raise AssertionError(cause)

    assert receiver.datagram(bundle(clock(1), *blend(JawOpen=1), APPLY), ("10.0.0.1", 1), Sink())
    now[0] = 5.0
    assert receiver.datagram(bundle(clock(1), *blend(MouthPucker=1), APPLY), ("10.0.0.2", 1), Sink())
    receiver._socket.close()
    assert [shown(packet) for packet in packets] == [{"jawOpen": 1}, {"mouthPucker": 1}]
    assert receiver.address.startswith("vmc://127.0.0.1:")


def test_a_sender_of_a_datagram_a_message_is_no_flood_and_ten_times_that_is() -> None:
    """53 shapes, the clock and `Apply`, each by itself, at 60 Hz: as many programs send them."""
    now, frames, causes = [0.0], [], []

    class Sink:
        def packet(self, packet: Packet, arrival: float) -> bool:
            frames.append(packet)
            return True

        def rejected(self, cause: Cause, detail: str = "", *, times: int = 1) -> None:
            causes.append(cause)

    receiver = VmcReceiver("127.0.0.1", 0, clock=lambda: now[0])
    receiver._socket.close()
    for frame in range(60):
        now[0] = frame / 60
        for data in (clock(frame / 60), *blend(JawOpen=0.5) * 53, APPLY):
            receiver.datagram(data, ("10.0.0.1", 1), Sink())
    assert len(frames) == 60 and not causes
    for _ in range(30_000):
        receiver.datagram(APPLY, ("10.0.0.1", 1), Sink())
    assert causes.count(Cause.FLOOD) > 20_000
