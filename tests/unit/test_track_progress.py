"""Long loops say how long they will still take; a slow first item is no trouble."""

from __future__ import annotations

import logging

import pytest

from cap4d.track import progress as module
from cap4d.track.progress import progress


def test_lines_come_now_and_then_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = iter([0.0, 8.0, 10.0, 11.0, 16.0])  # the start, then as each item is there
    monkeypatch.setattr(module.time, "monotonic", lambda: next(now))
    with caplog.at_level(logging.INFO):
        assert list(progress("abcd", "letters", 4)) == list("abcd")
    assert caplog.messages == ["letters: 1/4, 30 s left", "letters: 3/4, 5 s left"]
