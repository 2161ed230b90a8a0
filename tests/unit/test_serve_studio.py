"""What a studio draws, how often and for whom. Nothing is served; it is drawn when the test says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("onnx")

from cap4d.app.serve.jpeg import JpegEncoder
from cap4d.app.serve.message import Message, parse_message
from served_page import head_of, tiny_studio


class CountingPainter:
    """Counts, and paints in grey."""

    name = "grey"

    def __init__(self) -> None:
        self.poses = self.paints = 0

    def pose(self, frame) -> None:
        self.poses += 1

    def paint(self, camera, background) -> np.ndarray:
        self.paints += 1
        return np.full((camera.height, camera.width, 4), 128, np.uint8)


def test_who_was_slow_is_sent_the_latest_moment_and_nothing_between():
    now = 100.0
    studio, sent = tiny_studio(clock=lambda: now), []
    watcher, painter, encoder = studio.admit(sent.append), CountingPainter(), JpegEncoder()
    for now in (100.0, 100.05, 100.1, 100.2):  # noqa: B007  the studio's clock
        studio._draw_next(painter, encoder)
    assert [head_of(data)["at"] for data in sent] == [0.0, 0.042]
    now = 100.3
    assert studio.performance.number(now) == (7, 0)
    studio.hear(watcher, parse_message('{"ack": 1}'))
    studio._draw_next(painter, encoder)
    assert head_of(sent[-1])["at"] == 0.292  # frame 7 at 24 a second
    assert head_of(sent[-1])["latency"] == pytest.approx(250.0)
    assert len(sent) == painter.poses == 3


def test_a_moment_is_posed_once_and_equal_views_are_painted_once():
    studio, painter = tiny_studio(), CountingPainter()
    sent = {name: [] for name in "abc"}
    watchers = {name: studio.admit(messages.append) for name, messages in sent.items()}
    studio.hear(watchers["c"], parse_message('{"turn": [0.1, 0]}'))
    assert studio._draw_next(painter, JpegEncoder())
    assert (painter.poses, painter.paints) == (1, 2)
    assert [len(messages) for messages in sent.values()] == [1, 1, 1]


def test_a_live_head_is_turned_once_whoever_has_the_camera():
    studio = tiny_studio(turns_head=True)
    frame = studio._seen = replace(studio.performance.frame(), rot=np.float32([0, 0.5, 0]))
    watcher = studio.admit(lambda _: None)
    before = studio._camera(watcher.shot((0, 0), 0.0), frame, (0, 0))
    assert not np.allclose(before.viewmat, studio.avatar.camera.viewmat, atol=0.1)
    watcher.look(Message(zoom=0.0), studio._view)
    taken_over = studio._camera(watcher.shot((0, 0), 0.0), frame, (0, 0))
    assert np.allclose(taken_over.viewmat, before.viewmat, atol=1e-6)
