"""Cameras and what stands in for them; no sleeps: clocks are fakes."""

import threading

import av
import numpy as np
import pytest

from cap4d.drive.camera_device import Newest, PlayedVideo, check_device, open_camera
from cap4d.errors import ArgumentError, DataError

FPS, FRAMES = 25, 6


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "grey.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=FPS)
        stream.width = stream.height = 64
        for i in range(FRAMES):
            picture = np.full((64, 64, 3), 40 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


class Clock:
    """Time that passes only while somebody waits."""

    def __init__(self):
        self.now, self.waits = 100.0, []

    def __call__(self):
        return self.now

    def wait(self, seconds):
        self.waits.append(seconds)
        self.now += seconds


def test_a_video_plays_at_its_own_rate_over_and_over(video):
    clock = Clock()
    camera = PlayedVideo(video, clock=clock, wait=clock.wait)
    shades = [camera.read().mean() for _ in range(2 * FRAMES + 1)]
    np.testing.assert_allclose(clock.waits, 1 / FPS, atol=1e-6)
    np.testing.assert_allclose(shades, [40 * (i % FRAMES) for i in range(2 * FRAMES + 1)], atol=8)
    camera.close()


def test_who_reads_late_is_not_made_to_wait(video):
    clock = Clock()
    camera = PlayedVideo(video, clock=clock, wait=clock.wait)
    camera.read()
    clock.now += 10
    for _ in range(3):
        camera.read()
    assert clock.waits == []


def test_a_picture_is_rgb_bytes(video):
    picture = open_camera(str(video)).read()
    assert picture.shape == (64, 64, 3) and picture.dtype == np.uint8


@pytest.mark.parametrize("device", ["", "front", "-1", "1000", "0x1", "²", "/no/such.mp4", "/etc/passwd"])
def test_no_device(device):
    with pytest.raises(ArgumentError, match="webcam: expected webcam://0"):
        check_device(device)


def test_a_file_that_is_no_video(tmp_path):
    path = tmp_path / "broken.mp4"
    path.write_bytes(b"no video at all" * 100)
    with pytest.raises(DataError, match=r"broken\.mp4: video"):
        open_camera(str(path))


def test_a_camera_that_is_not_there(capfd):
    pytest.importorskip("cv2", reason="needs the extra [track]")
    with pytest.raises(OSError, match="no camera 987"):
        open_camera("987")
    assert capfd.readouterr() == ("", "")


def test_the_newest_wins():
    box = Newest()
    assert box.take(0) is None
    for thing in "abc":
        box.put(thing)
    assert box.take(0) == "c" and box.dropped == 2
    assert box.take(0) is None
    box.put("d")
    assert box.take(0) == "d" and box.dropped == 2


def test_who_waits_gets_what_comes():
    box, got = Newest(), []
    waiting = threading.Thread(target=lambda: got.append(box.take(30)))
    waiting.start()
    box.put("x")
    waiting.join(30)
    assert got == ["x"]
