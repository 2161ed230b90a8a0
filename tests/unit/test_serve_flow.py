"""How much a browser is sent, when, and how good. Times are passed in."""

from __future__ import annotations

import io

import numpy as np
import pytest
from cap4d.app.orbit import Orbit
from cap4d.app.playback import ClipPlayback, StreamPlayback
from cap4d.app.serve.flow import IN_FLIGHT, LEVELS, STALLED, Flow
from cap4d.app.serve.jpeg import JpegEncoder
from cap4d.app.serve.message import Message
from cap4d.app.serve.performance import Performance
from cap4d.app.serve.watcher import SHARPEN_SECONDS, Watcher, fitted_size

from cap4d.drive.clip import Clip, Frame

FPS = 30.0


def play(flow: Flow, latency: float, seconds: float, *, start: float = 0.0, number: int = 0) -> int:
    """Pictures at 30 a second, each acknowledged after `latency`; returns the next number."""
    events = []
    for i in range(int(seconds * FPS)):
        begun = start + i / FPS
        events += [(begun, "send", number + i, begun), (begun + latency, "ack", number + i, begun)]
    sent = set()
    for at, kind, n, begun in sorted(events):
        if kind == "send" and flow.ready:
            flow.sent(n, begun, at)
            sent.add(n)
        elif kind == "ack" and n in sent:
            flow.acknowledged(n, at)
    return number + int(seconds * FPS)


def test_two_pictures_are_on_their_way_and_no_more():
    flow = Flow()
    for number in range(IN_FLIGHT):
        assert flow.ready
        flow.sent(number, 0.0, 0.01)
    assert not flow.ready
    assert flow.acknowledged(0, 0.05) == pytest.approx(0.05)
    assert flow.ready


def test_an_echo_covers_those_before_it_and_a_made_up_one_nothing():
    flow = Flow()
    flow.sent(0, 0.0, 0.0)
    flow.sent(1, 0.1, 0.1)
    assert flow.acknowledged(2**53, 0.2) is None
    assert not flow.ready
    assert flow.acknowledged(0, 0.2) == pytest.approx(0.2)
    flow.sent(2, 0.3, 0.3)
    assert flow.acknowledged(2, 0.4) == pytest.approx(0.1)
    assert flow.acknowledged(2, 0.5) is None
    assert flow.acknowledged(1, 0.5) is None
    assert list(flow.latencies) == [pytest.approx(0.2), pytest.approx(0.1)]


def test_a_picture_that_is_never_shown_is_a_stall():
    flow = Flow()
    flow.sent(0, 0.0, 0.0)
    assert not flow.stalled(STALLED)
    assert flow.stalled(STALLED + 0.1)


def test_a_fast_line_keeps_the_best():
    flow = Flow()
    play(flow, 0.03, 20)
    assert flow.level == 0
    assert flow.latency == pytest.approx(0.03)


def test_a_line_that_gets_slow_gets_coarser_pictures_and_later_finer_ones_again():
    flow = Flow()
    number = play(flow, 0.03, 2)
    number = play(flow, 0.4, 20, start=2, number=number)
    assert flow.level == len(LEVELS) - 1
    play(flow, 0.03, 60, start=30, number=number)
    assert flow.level == 0


def test_a_line_that_is_long_by_itself_is_not_slow():
    flow = Flow()
    play(flow, 0.25, 30)
    assert flow.level == 0


def test_finer_pictures_that_were_too_much_are_tried_less_and_less_often():
    flow = Flow()
    number, changes, level = play(flow, 0.03, 2), [], 0
    for i in range(400):  # slow at level 0, fast from 1 on
        before = flow.level
        number = play(flow, 0.3 if flow.level == 0 else 0.03, 0.5, start=2 + 0.5 * i, number=number)
        if flow.level != before and flow.level == 0:
            changes.append(i)
        level = max(level, flow.level)
    assert len(changes) >= 3
    assert level == 1
    assert np.diff(changes)[-1] > 2 * np.diff(changes)[0]


# what a watcher sees -------------------------------------------------------------------------------


def orbit() -> Orbit:
    return Orbit(0, 0, 0.7, (0, 0, 0), 25)


def test_nothing_is_sent_twice():
    watcher, moment = Watcher(lambda data: None, area=512 * 512), (0, 0)
    assert watcher.wants(moment, 0.0)
    watcher.send(b"", moment, watcher.shot(moment, 0.0), begun=0.0, now=0.01)
    assert not watcher.wants(moment, 0.02)
    assert watcher.wants((1, 0), 0.02)
    watcher.look(Message(turn=(0.1, 0.0)), orbit)
    assert watcher.wants(moment, 0.02)


def test_a_picture_that_stands_is_sharpened_once():
    watcher, moment = Watcher(lambda data: None, area=512 * 512), (0, 0)
    watcher.flow.level = 4
    shot = watcher.shot(moment, 0.0)
    assert shot.size == (256, 256)
    watcher.send(b"", moment, shot, begun=0.0, now=0.0)
    watcher.flow.acknowledged(0, 0.1)
    assert not watcher.wants(moment, SHARPEN_SECONDS - 0.01)
    assert watcher.sharpens_at() == SHARPEN_SECONDS
    assert watcher.wants(moment, SHARPEN_SECONDS)
    sharp = watcher.shot(moment, SHARPEN_SECONDS)
    assert (sharp.size, sharp.quantiser) == ((512, 512), LEVELS[0].quantiser)
    watcher.send(b"", moment, sharp, begun=0.3, now=0.3)
    watcher.flow.acknowledged(1, 0.4)
    assert not watcher.wants(moment, 9.0)
    assert watcher.shot((1, 0), 9.0).size == (256, 256)  # it moves again


def test_a_drag_takes_the_camera_over_and_home_gives_it_back():
    watcher = Watcher(lambda data: None, area=512 * 512)
    watcher.look(Message(turn=(0.1, 0.0), zoom=1.0), orbit)
    assert watcher.orbit == orbit().turned(0.1, 0.0).zoomed(1.0)
    watcher.look(Message(home=True), orbit)
    assert watcher.orbit is None


@pytest.mark.parametrize("size", [(1100, 720), (390, 760), (16384, 1), (1, 16384), (16384, 16384), (100, 50)])
def test_a_picture_has_the_pages_shape_and_no_more_pixels_than_asked_for(size):
    width, height = fitted_size(size, 512 * 512)
    assert width % 2 == height % 2 == 0
    assert width * height <= 512 * 512
    if min(size) > 200:
        assert width / height == pytest.approx(size[0] / size[1], rel=0.02)
    if max(size) <= 500:
        assert (width, height) == size


# JPEG ----------------------------------------------------------------------------------------------


def test_a_jpeg_holds_the_picture():
    image_module = pytest.importorskip("PIL.Image")
    y, x = np.mgrid[0:48, 0:64] / 64
    image = np.stack([x, y, 0.5 * x + 0.2, np.ones_like(x)], -1)
    image = (255 * image).astype(np.uint8)
    encoder = JpegEncoder()
    data = [encoder.encode(image, quantiser) for quantiser in (2, 8, 31, 2)]
    decoded = np.asarray(image_module.open(io.BytesIO(data[0])).convert("RGB"), np.float64)
    assert decoded.shape == (48, 64, 3)
    assert np.abs(decoded - image[..., :3]).mean() < 2.0
    assert len(data[0]) > len(data[1]) > len(data[2])
    assert data[3] == data[0]


# what plays ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bundle():
    pytest.importorskip("onnx")
    from tiny_bundle import tiny_bundle

    return tiny_bundle(8, network=False)


def clip(frames: int = 10, fps: float = 10.0) -> Clip:
    zeros = np.zeros((frames, 3), np.float32)
    expr = np.zeros((frames, 5), np.float32)
    expr[:, 4] = np.arange(frames)
    return Clip("tiny", fps, expr, zeros, zeros, zeros)


def face(performance: Performance, now: float) -> float:
    performance.number(now)
    return float(performance.frame().expr[4])


def test_a_clip_plays_its_own_frames_on_the_clock_again_and_again(bundle):
    performance = Performance(ClipPlayback(clip(), 100.0), bundle)
    assert [face(performance, 100.01 + i / 10) for i in range(12)] == [*range(10), 0, 1]
    assert performance.due() == pytest.approx(101.2)
    assert performance.position == pytest.approx(0.1)
    assert (performance.is_live, performance.duration, performance.state) == (False, 1.0, "")


def test_a_clip_stands_goes_on_and_moves(bundle):
    performance = Performance(ClipPlayback(clip(), 100.0), bundle)
    assert face(performance, 100.35) == 3
    performance.pause(True, 100.35)
    performance.pause(True, 100.36)
    assert face(performance, 150.0) == 3
    assert performance.due() == float("inf")
    performance.pause(False, 200.0)
    assert face(performance, 200.21) == 5
    performance.seek(0.8, 300.0)
    assert [face(performance, now) for now in (300.0, 300.11)] == [8, 9]
    performance.pause(True, 300.11)
    performance.seek(99.0, 300.2)
    assert face(performance, 400.0) == 9


def test_a_clip_of_a_thousand_frames_a_second_is_not_drawn_so_often(bundle):
    performance = Performance(ClipPlayback(clip(4000, 1000.0), 100.0), bundle)
    numbers = {performance.number(100 + i / 2000) for i in range(2000)}
    assert 55 <= len(numbers) <= 69


class FakeStream:
    """Moves with the time it is asked at."""

    state, error, address = "playing", None, "tcp://127.0.0.1:1"

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None: ...

    def frame(self, now: float) -> Frame:
        zero = np.zeros(3, np.float32)
        return Frame(now, "tiny", np.float32([0, 0, 0, 0, now]), zero, zero, zero)

    def shown(self, now: float) -> None: ...

    def statistics(self) -> dict:
        return {"received": 3}


def test_a_stream_is_frozen_and_goes_on(bundle):
    performance = Performance(StreamPlayback(FakeStream(), rig_name="tiny"), bundle)
    assert face(performance, 1.0) == 1.0
    performance.pause(True, 1.0)
    before = performance.number(1.0)
    assert face(performance, 2.0) == 1.0
    assert performance.number(9.0) == before
    performance.pause(False, 9.0)
    assert face(performance, 9.1) == pytest.approx(9.1)
    performance.seek(3.0, 9.2)
    assert (performance.is_live, performance.duration, performance.state) == (True, 0.0, "playing")


def test_a_stream_is_looked_at_thirty_times_a_second(bundle):
    performance = Performance(StreamPlayback(FakeStream(), rig_name="tiny"), bundle)
    numbers = {performance.number(100 + i / 1000) for i in range(1000)}
    assert 29 <= len(numbers) <= 32


def test_held_expressions_stay_within_their_range_and_let_go(bundle):
    performance = Performance(ClipPlayback(bundle.idle, 0.0), bundle)
    assert performance.number(0.0) == (0, 0)
    before = performance.frame().expr.copy()
    performance.hold("jawOpen", 7.0)
    performance.hold("no such", 1.0)
    assert performance.number(0.0) == (0, 1)
    held = performance.frame().expr
    assert held[0] == 1.0
    np.testing.assert_array_equal(held[1:], before[1:])
    np.testing.assert_array_equal(bundle.idle.expr[0], before)
    assert performance.held == {"jawOpen": 1.0}
    performance.overrides.reset()
    assert performance.held == {}
    np.testing.assert_array_equal(performance.frame().expr, before)
