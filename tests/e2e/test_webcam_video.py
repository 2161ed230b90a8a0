"""A person on video before the "camera" drives two kinds of head; MediaPipe and the solver are real."""

import threading
import time

import numpy as np
import pytest
from painted_bundle import painted_bundle

for module in ("cv2", "mediapipe"):
    pytest.importorskip(module, reason="needs OpenCV and mediapipe")

from cap4d.drive.camera_device import PlayedVideo  # noqa: E402
from cap4d.drive.face_driver import FaceDriver  # noqa: E402
from cap4d.drive.landmark_head import find_landmark_head  # noqa: E402
from cap4d.drive.webcam import WebcamReceiver  # noqa: E402
from cap4d.track.landmarks import Detector, without_native_chatter  # noqa: E402

FRAMES, FPS = 183, 30
REST, PUCKER, SMILE, O_SHAPE = range(0, 5), range(18, 28), range(115, 132), range(140, 158)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def video(shared):
    return shared / "video" / "talking_head.mp4"


@pytest.fixture(scope="module")
def landmarks(video):
    """Of each frame."""
    camera = PlayedVideo(video, clock=lambda: 0.0, wait=lambda _: None)
    with without_native_chatter(), Detector(video=True, copies=1) as detector:
        return [detector.landmarks(camera.read()) for _ in range(FRAMES)]


@pytest.fixture(scope="module", params=["builtin", "ict"])
def bundle(request, shared, builtin_rig):
    if request.param == "builtin":
        return painted_bundle(builtin_rig)
    from cap4d.rig.ict import import_ict

    return painted_bundle(import_ict(shared / "ict" / "ict_facekit_light.npz"))


@pytest.fixture(scope="module")
def driven(bundle, landmarks):
    """Name -> float[183] of the video's second time round, when the resting face is known."""
    with without_native_chatter():
        driver = FaceDriver(find_landmark_head(bundle))
    packets = [driver(points, 512, 512, i / FPS) for i, points in enumerate(landmarks * 2)]
    expr = np.array([packet.expr for packet in packets[FRAMES:]])
    names = [name.replace("Left", "_L").replace("Right", "_R") for name in bundle.subject.expression_names]
    return dict(zip(names, expr.T, strict=True))


def test_lips_follow(driven):
    def mean(name, frames):
        return float(driven[name][list(frames)].mean())

    assert mean("jawOpen", O_SHAPE) > 0.35 > 0.12 > mean("jawOpen", REST)
    assert mean("mouthPucker", PUCKER) > mean("mouthPucker", REST) + 0.15
    assert min(mean("mouthSmile_L", SMILE), mean("mouthSmile_R", SMILE)) > 0.7
    assert max(mean("mouthSmile_L", REST), mean("mouthSmile_R", REST)) < 0.3


def test_brows_go_up_with_the_o(driven):
    up = [value for name, value in driven.items() if name.startswith("browInnerUp")]
    assert np.mean([v[list(O_SHAPE)].mean() for v in up]) > 0.3 > 0.1 > np.mean([v[:5].mean() for v in up])


def test_eyes_that_stay_open_stay_open(driven):
    for name in ("eyeBlink_L", "eyeBlink_R"):
        assert np.quantile(driven[name], 0.9) < 0.35


def test_the_camera_drives_at_its_own_pace(bundle, video):
    class Sink:
        def __init__(self):
            self.packets, self.late = [], []

        def packet(self, packet, arrival):
            self.packets.append(packet)
            self.late.append(arrival - packet.t)

        def rejected(self, cause, detail=""):
            raise AssertionError(cause)

    sink, stop = Sink(), threading.Event()
    receiver = WebcamReceiver(f"webcam://{video}", bundle)
    running = threading.Thread(target=receiver.run, args=(sink, stop))
    running.start()
    end = time.monotonic() + 60
    while len(sink.packets) < 90 and time.monotonic() < end:
        time.sleep(0.02)
    stop.set()
    running.join(10)
    assert not running.is_alive() and len(sink.packets) >= 90
    stats = receiver.statistics()
    assert 0 <= stats["pictures"] - stats["dropped"] - stats["no_face"] - len(sink.packets) <= 1
    assert stats["no_face"] == 0 and stats["rate"] < 1.1 * FPS
    assert np.median(sink.late) < 0.2  # s, of a machine that does other things too
