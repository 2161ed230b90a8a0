"""Live Link Face: packets written byte by byte from the format's description drive every kind of rig."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from drive_bundle import on_rig
from receiving import datagrams, running, until_heard
from tiny_bundle import tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.arkit import COLUMN, NAMES
from cap4d.drive.convert import Converter
from cap4d.drive.livelink import ANGLES, MAX_PACKET, LiveLinkReceiver, parse_livelink
from cap4d.drive.open_live import open_live
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.head import HeadRig
from cap4d.rotation import axis_angle_to_rotmat

DEVICE = b"8E6CA1A4-0C9D-4B49-9C6C-3D3A6F0B2F11"  # 36 characters

# The app's own row of a recording: the person looks up and to the left.
LOOKING = {
    **{"EyeLookOutLeft": 0.5030736923, "EyeLookUpLeft": 0.3807524741},
    **{"EyeLookInRight": 0.5970684290, "EyeLookUpRight": 0.3733466268},
    **{"LeftEyeYaw": -0.3596782684, "LeftEyePitch": -0.1741501987, "LeftEyeRoll": 0.0618444942},
    **{"RightEyeYaw": -0.3029436469, "RightEyePitch": -0.1741401106, "RightEyeRoll": 0.0524348840},
}


def values_of(**by_name: float) -> list[float]:
    """61 values; names as the app spells them."""
    order = [name[0].upper() + name[1:] for name in NAMES] + list(ANGLES)
    assert set(by_name) <= set(order)
    return [by_name.get(name, 0.0) for name in order]


def packet(
    values: list[float] | None,
    *,
    frame: int = 2_756_340,
    part: float = 0.25,
    rate: tuple[int, int] = (60, 1),
    name: bytes = b"iPhone",
) -> bytes:
    """Byte by byte, as the format is described; None: no face, so it ends with the name."""
    data = bytes([6])
    data += bytes([0, 0, 0, 36]) + DEVICE
    data += struct.pack(">I", len(name)) + name
    if values is None:
        return data
    data += struct.pack(">i", frame) + struct.pack(">f", part)
    data += struct.pack(">i", rate[0]) + struct.pack(">i", rate[1])
    return data + bytes([len(values)]) + b"".join(struct.pack(">f", value) for value in values)


def refused(data: bytes) -> Cause:
    with pytest.raises(Rejected) as caught:
        parse_livelink(data)
    return caught.value.cause


def test_a_packet_as_it_stands_on_the_wire() -> None:
    """Against bytes written out, so that the helper above is held to the description too."""
    data = bytes.fromhex("06 00000024") + DEVICE + bytes.fromhex("00000006 6950686f6e65")
    data += bytes.fromhex("00000078 3f000000 0000003c 00000001 3d")
    data += bytes.fromhex("00000000") * 17 + bytes.fromhex("3f400000") + bytes.fromhex("00000000") * 43
    assert len(data) == 1 + 4 + 36 + 4 + 6 + 16 + 1 + 244
    found = parse_livelink(data)
    assert found.t == 120.5 / 60
    assert found.arkit[COLUMN["jawOpen"]] == 0.75 and np.count_nonzero(found.arkit) == 1
    assert found.arkit.dtype == np.float32 and found.rot is None and found.eye_rot is None
    assert data == packet(values_of(JawOpen=0.75), frame=120, part=0.5)


def test_every_name_is_where_unreal_puts_it() -> None:
    found = parse_livelink(packet([i / 61 for i in range(61)]))
    assert np.allclose(found.arkit, np.arange(52) / 61)
    places = {"eyeBlinkLeft": 0, "jawForward": 14, "jawLeft": 15, "jawRight": 16, "jawOpen": 17}
    places |= {"mouthLeft": 21, "mouthRight": 22, "browInnerUp": 43, "tongueOut": 51}
    assert {name: NAMES.index(name) for name in places} == places


def test_time_is_the_time_code() -> None:
    assert (
        parse_livelink(packet(values_of(), frame=1001, part=0.5, rate=(30000, 1001))).t
        == 1001.5 * 1001 / 30000
    )
    assert parse_livelink(packet(values_of())).t == pytest.approx((2_756_340 + 0.25) / 60)


def test_gaze_and_head_in_the_rigs_axes() -> None:
    found = parse_livelink(packet(values_of(**LOOKING)))
    forward = axis_angle_to_rotmat(found.eye_rot.astype(float)) @ [0, 0, 1]
    yaw, pitch = np.arctan2(forward[0], forward[2]), np.arcsin(-forward[1])
    assert np.allclose([yaw, pitch], [(0.3596782684 + 0.3029436469) / 2, -0.17414515], atol=1e-6)
    assert found.rot is None
    head = parse_livelink(packet(values_of(HeadYaw=-0.3, HeadPitch=0.2, HeadRoll=0.1)))
    nose = axis_angle_to_rotmat(head.rot.astype(float)) @ [0, 0, 1]
    assert nose[0] > 0.25 and nose[1] < -0.15, "to the person's left (+x) and down"
    tilted = parse_livelink(packet(values_of(HeadRoll=0.1)))
    assert np.allclose(tilted.rot, [0, 0, -0.1]), "the crown towards the person's left"
    assert np.array_equal(head.neck_rot, -head.rot) and not head.tra.any(), "shoulders stay"


def test_no_face_is_no_frame() -> None:
    assert parse_livelink(packet(None)) is None
    assert parse_livelink(packet([])) is None
    assert parse_livelink(packet([])[:-1]) is None


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", Cause.SYNTAX),
        (b"\x05" + packet(values_of())[1:], Cause.SYNTAX),
        (packet(values_of())[:3], Cause.SYNTAX),
        (packet(values_of())[:20], Cause.SYNTAX),
        (packet(values_of())[:60], Cause.SYNTAX),
        (packet(values_of())[:-1], Cause.SHAPE),
        (packet(values_of()) + b"\0", Cause.SHAPE),
        (packet(values_of()[:60]), Cause.SHAPE),
        (packet(values_of() + [0.0]), Cause.SHAPE),
        (b"\x06" + b"\xff" * 300, Cause.SYNTAX),
        (bytes(MAX_PACKET + 1), Cause.SIZE),
        (packet(values_of(), name=b"x" * 257), Cause.SYNTAX),
        (packet(values_of(JawOpen=float("nan"))), Cause.NOT_FINITE),
        (packet(values_of(HeadYaw=float("inf"))), Cause.NOT_FINITE),
        (packet(values_of(), frame=-1), Cause.TIME),
        (packet(values_of(), part=float("nan")), Cause.TIME),
        (packet(values_of(), rate=(0, 1)), Cause.TIME),
        (packet(values_of(), rate=(60, 0)), Cause.TIME),
        (packet(values_of(), rate=(-60, -1)), Cause.TIME),
        (packet(values_of(), rate=(2**31 - 1, 1)), Cause.TIME),
    ],
)
def test_what_is_no_packet_is_refused_with_its_cause(data: bytes, cause: Cause) -> None:
    assert refused(data) == cause


def test_cut_or_flipped_anywhere_nothing_else_is_raised() -> None:
    rng, whole = np.random.default_rng(0), packet(values_of(JawOpen=0.5))
    for cut in range(len(whole)):
        with contextlib.suppress(Rejected):
            assert parse_livelink(whole[:cut]) is None
    for _ in range(3000):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(256)
        try:
            found = parse_livelink(bytes(data))
        except Rejected:
            continue
        assert found is None or (np.isfinite(found.arkit).all() and np.isfinite(found.t))


@pytest.mark.parametrize("rig", ["builtin", "ict"])
def test_packets_drive_the_rigs(rig: str, builtin_rig: HeadRig, request: pytest.FixtureRequest) -> None:
    """What the packet says is what the mesh does: the jaw down, the left eye shut, the right one not."""
    if rig == "builtin":
        head = builtin_rig
    else:
        from cap4d.rig.ict import import_ict

        head = import_ict(request.getfixturevalue("shared") / "ict/ict_facekit_light.npz")
    convert, subject = Converter(on_rig(head, size=64)), head.subject()
    neutral = subject.pose(convert.neutral().expr)

    def motion(**by_name: float) -> np.ndarray:
        frame = convert(parse_livelink(packet(values_of(**by_name))))
        return subject.pose(frame.expr, eye_rot=frame.eye_rot, neck_rot=frame.neck_rot) - neutral

    jaw = motion(JawOpen=1)
    chin = np.abs(neutral[:, 0]) < 0.01
    assert jaw[chin, 1].min() < -0.02 and jaw[:, 1].max() < 0.005
    blink = motion(EyeBlinkLeft=1)
    moved = np.linalg.norm(blink, axis=1)
    left, right = neutral[:, 0] > 0.005, neutral[:, 0] < -0.005
    assert moved[left].max() > 0.007 and moved[right].max() < 5e-4
    smile = motion(MouthSmileLeft=1, MouthSmileRight=1)
    corners = np.linalg.norm(smile, axis=1) > 0.6 * np.linalg.norm(smile, axis=1).max()
    assert smile[corners, 1].mean() > 0.003
    assert (smile[corners & left, 0] > 0).all() and (smile[corners & right, 0] < 0).all(), "wider"
    eyes = [j for j, driver in enumerate(subject.joint_drivers) if driver == "eyes"]
    balls = subject.skin_weights[:, eyes].sum(1) > 0.99
    front = balls & (neutral[:, 2] > np.quantile(neutral[balls, 2], 0.9))
    assert motion(**LOOKING)[front, 0].mean() > 0.002 and motion(**LOOKING)[front, 1].mean() > 0.001


class Listener:
    """A sink that remembers."""

    def __init__(self) -> None:
        self.packets: list[Packet] = []
        self.causes: list[Cause] = []
        self.got = threading.Semaphore(0)

    def packet(self, packet: Packet, arrival: float) -> bool:
        self.packets.append(packet)
        self.got.release()
        return True

    def rejected(self, cause: Cause, detail: str = "", *, times: int = 1) -> None:
        self.causes += [cause] * times
        self.got.release()


def test_through_a_real_socket() -> None:
    receiver, sink, stop = LiveLinkReceiver("127.0.0.1", 0), Listener(), threading.Event()
    thread = threading.Thread(target=receiver.run, args=(sink, stop))
    thread.start()
    port = int(receiver.address.rpartition(":")[2])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
        for frame in range(3):
            phone.sendto(packet(values_of(JawOpen=0.25 * frame), frame=frame, part=0), ("127.0.0.1", port))
        phone.sendto(b"garbage", ("127.0.0.1", port))
        phone.sendto(packet(None), ("127.0.0.1", port))
        assert all(sink.got.acquire(timeout=5) for _ in range(4))
    stop.set()
    thread.join(2)
    assert not thread.is_alive() and receiver.address.startswith("livelink://127.0.0.1:")
    assert [p.arkit[COLUMN["jawOpen"]] for p in sink.packets] == [0, 0.25, 0.5]
    assert np.allclose([p.t for p in sink.packets], np.arange(3) / 60) and sink.causes == [Cause.SYNTAX]


def test_a_live_stream_of_a_phone_moves_the_face(builtin_rig: HeadRig) -> None:
    """The whole road: datagrams, buffer, conversion; in real time."""
    bundle = on_rig(builtin_rig, size=32)
    jaw = bundle.subject.expression_names.index("jawOpen")
    with open_live("livelink://127.0.0.1:0", bundle) as stream:
        port = int(stream.address.rpartition(":")[2])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
            for frame in range(600):
                data = packet(values_of(JawOpen=0.75), frame=frame, part=0)
                phone.sendto(data, ("127.0.0.1", port))
                shown = stream.frame(time.monotonic())
                if np.isclose(shown.expr[jaw], 0.75, atol=1e-3):  # the first packets ease in
                    break
                time.sleep(1 / 60)
    assert np.isclose(shown.expr[jaw], 0.75, atol=1e-3) and np.count_nonzero(shown.expr) == 1


def test_one_phone_rules_until_it_is_silent() -> None:
    now = [0.0]
    receiver, sink = LiveLinkReceiver("127.0.0.1", 0, clock=lambda: now[0]), Listener()
    data, first, second = packet(values_of()), ("10.0.0.1", 5), ("10.0.0.2", 5)
    assert receiver.datagram(data, first, sink) and not receiver.datagram(data, second, sink)
    now[0] = 1.5
    assert receiver.datagram(data, second, sink) and not receiver.datagram(data, first, sink)
    assert sink.causes == [Cause.SENDER] * 2 and len(sink.packets) == 2
    receiver._socket.close()


def test_only_who_may_send() -> None:
    receiver, sink = LiveLinkReceiver("127.0.0.1", 0, sender="192.168.7.20"), Listener()
    data = packet(values_of())
    assert not receiver.datagram(data, ("192.168.7.21", 5), sink)
    assert receiver.datagram(data, ("192.168.7.20", 5), sink)
    assert sink.causes == [Cause.SENDER]
    assert receiver.datagram(data, ("::ffff:192.168.7.20", 5, 0, 0), sink) is False, (
        "another port, another sender"
    )
    receiver._socket.close()
    with pytest.raises(ArgumentError, match="expected from=ADDRESS"):
        LiveLinkReceiver("127.0.0.1", 0, sender="no such host.invalid")


def test_a_flood_is_bounded() -> None:
    receiver, sink = LiveLinkReceiver("127.0.0.1", 0, clock=lambda: 0.0), Listener()
    data = packet(values_of())
    for _ in range(1000):
        receiver.datagram(data, ("10.0.0.1", 5), sink)
    assert len(sink.packets) == 150 and sink.causes == [Cause.FLOOD] * 850
    receiver._socket.close()


def test_a_flood_of_another_sender_does_not_silence_who_rules() -> None:
    receiver, sink = LiveLinkReceiver("127.0.0.1", 0, clock=lambda: 0.0), Listener()
    receiver._socket.close()
    data = packet(values_of())
    assert receiver.datagram(data, ("10.0.0.1", 5), sink)
    for _ in range(1000):
        receiver.datagram(data, ("10.0.0.2", 5), sink)
    assert receiver.datagram(data, ("10.0.0.1", 5), sink)
    assert sink.causes == [Cause.SENDER] * 1000


HEADER = ["Timecode", "BlendShapeCount"] + [name[0].upper() + name[1:] for name in NAMES] + list(ANGLES)


def recording(path: Path, codes: list[str], rows: list[dict[str, float]], header: list[str] = HEADER) -> Path:
    lines = [",".join(header)]
    for code, row in zip(codes, rows, strict=True):
        lines.append(",".join([code, "61", *(f"{row.get(name, 0):.10f}" for name in header[2:])]))
    path.write_text("\n".join(lines) + "\n")
    return path


def jaws(path: Path, bundle: Bundle, **options: float) -> np.ndarray:
    return open_source(str(path), bundle, **options).expr[:, 0]


def test_a_recording_becomes_a_clip(tmp_path: Path) -> None:
    bundle = tiny_bundle(8, network=False)
    codes = [f"12:27:{47 + k // 30:02d}:{2 * (k % 30):02d}.169" for k in range(60)]  # 30 fps of a 60 fps code
    rows = [{"JawOpen": k / 60, **LOOKING, "HeadYaw": -0.1 * k / 60} for k in range(60)]
    clip = open_source(str(recording(tmp_path / "take.csv", codes, rows)), bundle)
    assert clip.fps == 30 and len(clip) == 60 and clip.rig_name == bundle.rig_name
    assert np.allclose(clip.expr[:, 0], np.arange(60) / 60, atol=1e-6) and not clip.expr[:, 1:].any()
    assert clip.eye_rot[:, 1].min() > 0.3 and np.allclose(clip.rot[:, 1], 0.1 * np.arange(60) / 60, atol=1e-6)
    assert np.array_equal(clip.neck_rot, -clip.rot) and not clip.tra.any()
    assert clip.expr.dtype == clip.eye_rot.dtype == clip.rot.dtype == np.float32


def test_columns_go_by_their_names(tmp_path: Path) -> None:
    """Older versions of the app write the right eye first; newer ones jawRight before jawLeft."""
    bundle = tiny_bundle(8, network=False)
    rows = [{"JawOpen": 0.5, "EyeBlinkLeft": 0.25}] * 2
    mixed = HEADER[:2] + HEADER[:1:-1]
    path = recording(tmp_path / "a.csv", ["00:00:00:00.0", "00:00:00:01.0"], rows, mixed)
    clip = open_source(str(path), bundle)
    assert np.allclose(clip.expr[0], [0.5, 0.25, 0, 0, 0])
    no_angles = ["Timecode", "BlendShapeCount", *NAMES]
    lower = recording(tmp_path / "b.csv", ["00:00:00:00.0"], [{"jawOpen": 0.5}], no_angles)
    clip = open_source(str(lower), bundle)
    assert clip.expr[0, 0] == 0.5 and clip.rot is None and not clip.neck_rot.any()


def test_gaps_rows_without_a_face_and_midnight(tmp_path: Path) -> None:
    bundle = tiny_bundle(8, network=False)
    path = recording(
        tmp_path / "a.csv",
        ["23:59:59:58.0", "23:59:59:59.0", "00:00:00:00.0", "00:00:00:03.0"],
        [{"JawOpen": x} for x in (0.0, 0.1, 0.2, 0.5)],
    )
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], "23:59:59:59.5,0", *lines[3:]]))
    assert np.allclose(jaws(path, bundle), np.arange(6) / 10, atol=1e-6)
    assert np.allclose(jaws(path, bundle, fps=10), [0, 0.1, 0.15, 0.2, 0.5], atol=1e-6)  # a row every tenth


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "header"),
        ("a,b,c\n1,2,3\n", "header"),
        (",".join(HEADER), "rows"),
        (",".join(HEADER) + "\n12:00:00:00.0,0\n", "rows"),
        (",".join(HEADER) + "\n12:00:00:00.0,61" + ",x" * 61, "row 2"),
        (",".join(HEADER) + "\n12:00:00,61" + ",0" * 61, "row 2"),
        (",".join(HEADER) + "\n99:00:00:00,61" + ",0" * 61, "row 2"),
        (",".join(HEADER) + "\n12:00:00:nan,61" + ",0" * 61, "row 2"),
        (",".join(HEADER) + "\n12:00:00:00,61" + ",nan" * 61, "values"),
        (",".join(HEADER) + "\n12:00:00:00,61" + ",1e99" * 61, "values"),
        (",".join(HEADER) + "\n12:00:00:05,61" + ",0" * 61 + "\n12:00:00:01,61" + ",0" * 61, "Timecode"),
        (",".join(HEADER) + "\n12:00:00:05,61" + ",0" * 61 + "\n13:00:00:01,61" + ",0" * 61, "Timecode"),
        ("x" * 100_000, "line"),
        ("\0" * 100, "header"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(text: str, field: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        open_source(str(path), tiny_bundle(8, network=False))
    assert caught.value.field == field and "\n" not in str(caught.value)


def test_a_missing_recording(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        open_source(str(tmp_path / "none.csv"), tiny_bundle(8, network=False))


def test_live_link_can_be_run_again() -> None:
    receiver = LiveLinkReceiver("127.0.0.1", 0)
    with running(receiver):
        pass
    with running(receiver) as sink, datagrams(receiver) as send:
        until_heard(sink, lambda: send(b"garbage"), lambda: sink.causes["syntax"])
