"""The receiver with a camera and a detector of our own: no MediaPipe, no sleeps."""

import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from synthetic_face import NAMES, SIZE, landmark_head, seen

import cap4d.drive.webcam as webcam
from cap4d.drive.webcam import WebcamReceiver
from cap4d.errors import ArgumentError

LONG = 60.0  # s until a test that hangs fails


class Script:
    """Cameras that deliver numbered pictures, each when the last one was dealt with, and a detector."""

    def __init__(self, *cameras, faces=None):
        self.cameras, self.faces = list(cameras), faces or {}
        self.dealt, self.closed, self.over = threading.Semaphore(1), 0, threading.Event()
        self.looked: list[int] = []
        self.last, self.done = [n for c in cameras for n in c if isinstance(n, int)][-1], threading.Event()

    def open(self, _device):
        if not self.cameras:
            self.over.set()
            raise OSError("no camera 0")
        self.left = list(self.cameras.pop(0))
        if self.left == ["gone"]:
            raise OSError("no camera 0")
        return self

    def read(self):
        if not self.left:
            return None
        number = self.left.pop(0)
        if isinstance(number, Exception):
            raise number
        assert self.dealt.acquire(timeout=LONG)
        picture = np.zeros((SIZE, SIZE, 3), np.uint8)
        picture[0, 0, 0] = number
        return picture

    def close(self):
        self.closed += 1

    @contextmanager
    def detector(self):
        yield self

    def landmarks(self, picture):
        number = int(picture[0, 0, 0])
        self.looked.append(number)
        self.dealt.release()
        if number == self.last:
            self.done.set()
        return self.faces.get(number, seen({"jawOpen": 0.1 * number}))


class Got:
    def __init__(self):
        self.packets, self.arrivals, self.causes = [], [], []

    def packet(self, packet, arrival):
        self.packets.append(packet)
        self.arrivals.append(arrival)

    def rejected(self, cause, detail=""):
        self.causes.append(cause)


class Ticks:
    """A clock that goes on by a thirtieth of a second whenever it is read."""

    def __init__(self):
        self.now, self.lock = 0.0, threading.Lock()

    def __call__(self):
        with self.lock:
            self.now += 1 / 30
            return self.now


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr(webcam, "RETRY", 0.0)
    monkeypatch.setattr(webcam, "PATIENCE", 0.01)


def play(script):
    got, stop = Got(), threading.Event()
    receiver = WebcamReceiver(
        "0", None, camera=script.open, detector=script.detector, head=landmark_head(), clock=Ticks()
    )
    running = threading.Thread(target=receiver.run, args=(got, stop))
    running.start()
    assert script.over.wait(LONG) and script.done.wait(LONG)
    stop.set()
    running.join(LONG)
    assert not running.is_alive()
    return receiver, got


def test_every_picture_of_a_slow_camera_is_a_packet():
    receiver, got = play(Script(range(6)))
    assert [packet.rig_name for packet in got.packets] == ["synthetic"] * 6
    times = [packet.t for packet in got.packets]
    assert times == sorted(set(times)) and all(a > t for a, t in zip(got.arrivals, times, strict=True))
    jaw = [packet.expr[NAMES.index("jawOpen")] for packet in got.packets]
    assert jaw[-1] > 0.3 and jaw == sorted(jaw)
    stats = receiver.statistics()
    assert (stats["pictures"], stats["no_face"], stats["dropped"]) == (6, 0, 0)
    assert stats["rate"] > 0 and stats["solve_ms"] > 0 and not stats["connected"]


def test_no_face_is_no_packet():
    nothing = {1: None, 2: np.full((478, 2), np.nan), 4: np.zeros((478, 2))}
    receiver, got = play(Script(range(6), faces=nothing))
    assert len(got.packets) == 3 and receiver.statistics()["no_face"] == 3
    assert got.causes == []


def test_a_camera_that_is_pulled_out_comes_back():
    script = Script(range(3), ["gone"], ["gone"], [3, OSError("pulled out")], range(4, 6))
    receiver, got = play(script)
    assert script.looked == [0, 1, 2, 3, 4, 5] and len(got.packets) == 6
    assert script.closed == 3
    assert receiver.statistics()["reconnects"] >= 5


def test_pictures_that_nobody_had_time_for_are_dropped_and_counted():
    script = Script(range(9))
    script.dealt = threading.Semaphore(100)  # the camera does not wait
    looking, first = script.landmarks, threading.Event()

    def landmarks(picture):
        if not first.is_set():
            first.set()
            assert script.over.wait(LONG)  # the first look takes until the camera has nothing more
        return looking(picture)

    script.landmarks = landmarks
    receiver, got = play(script)
    assert script.looked[-1] == 8 and len(script.looked) == len(got.packets) <= 3
    stats = receiver.statistics()
    assert stats["dropped"] == 9 - len(got.packets)


def test_it_stops_while_the_camera_hangs():
    script, hangs, stop = Script(range(1)), threading.Event(), threading.Event()
    reading = threading.Event()

    def read():
        reading.set()
        hangs.wait(LONG)

    script.read = read
    receiver = WebcamReceiver("0", None, camera=script.open, detector=script.detector, head=landmark_head())
    running = threading.Thread(target=receiver.run, args=(Got(), stop))
    running.start()
    assert reading.wait(LONG)
    stop.set()
    running.join(LONG / 4)  # while it still hangs
    assert not running.is_alive()
    hangs.set()


def test_a_run_that_fails_lets_go_of_the_camera(monkeypatch):
    monkeypatch.setattr(webcam, "PATIENCE", LONG)
    script, stop = Script(range(9)), threading.Event()
    script.dealt = threading.Semaphore(100)

    def landmarks(picture):
        raise ZeroDivisionError

    script.landmarks = landmarks
    receiver = WebcamReceiver("0", None, camera=script.open, detector=script.detector, head=landmark_head())
    before = set(threading.enumerate())
    try:
        with pytest.raises(ZeroDivisionError):
            receiver.run(Got(), stop)
        assert set(threading.enumerate()) <= before and script.closed == 1  # other tests end theirs
    finally:
        stop.set()


@pytest.mark.parametrize("device", ["webcam://front door", "webcam:///no/such.mp4", "webcam://"])
def test_a_device_that_is_none_is_refused(device):
    with pytest.raises(ArgumentError, match="webcam: expected webcam://0"):
        WebcamReceiver(device, None)


def test_the_address_names_the_device():
    assert WebcamReceiver("webcam://0", None).address == WebcamReceiver("0", None).address == "webcam://0"


@pytest.mark.parametrize("missing", ["mediapipe", "cv2"])
def test_what_is_not_installed_is_one_line_that_says_how(missing, monkeypatch):
    pytest.importorskip("cv2", reason="needs the extra [track]")
    for module in [name for name in sys.modules if name.split(".")[0] == missing or "track.landm" in name]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ArgumentError, match=r"pip install --no-deps mediapipe==0\.10\.21") as caught:
        WebcamReceiver("0", None).run(Got(), threading.Event())
    assert "\n" not in str(caught.value)


def test_importing_it_imports_nothing_heavy():
    heavy = ("torch", "cv2", "mediapipe", "scipy", "OpenImageIO")
    code = f"import sys, cap4d.drive.webcam; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
