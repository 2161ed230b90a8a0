"""Who is held back, and who is not."""

from __future__ import annotations

import os

import pytest

from cap4d.drive.pace import MAX_STEP, Pace, unread


def pour(pace: Pace, frames: int, *, rate: float = 30.0, now: float = 0.0) -> float:
    """When the last of frames that are all there at once is let through, s after the first."""
    for i in range(frames):
        now += pace.lead(i / rate, now, size=100, waiting=100 * (frames - 1 - i))
    return now


def test_a_file_plays_at_its_own_speed() -> None:
    assert pour(Pace(), 301) == pytest.approx(10.0, rel=0.02)


def test_a_handful_that_waited_is_let_through_at_once() -> None:
    assert pour(Pace(), 10) == 0.0


def test_a_live_sender_is_never_held_back() -> None:
    pace = Pace()
    late = [0.3, 0.2, 0.0, 0.05, 0.4, 0.35, 0.3] * 20
    for i, delay in enumerate(late):
        waiting = 100 * sum(j / 30 + d <= i / 30 + delay for j, d in enumerate(late) if j > i)
        assert pace.lead(i / 30, i / 30 + delay, size=100, waiting=waiting) == 0


def test_what_was_held_up_catches_up_at_once() -> None:
    pace = Pace()
    for i in range(100):
        pace.lead(i / 30, i / 30, size=100, waiting=0)
    for i in range(100, 145):  # a second and a half of it
        assert pace.lead(i / 30, 145 / 30, size=100, waiting=100 * (144 - i)) < 0.02


def test_what_a_speech_model_sends_at_once_after_a_pause_is_played_at_its_speed() -> None:
    pace, now = Pace(), 0.0
    for start in (0.0, 60.0, 65.0):  # utterances of two seconds
        now = max(now, start)
        for i in range(60):
            now += pace.lead(i / 30, now, size=100, waiting=100 * (59 - i))
        assert now - start == pytest.approx(59 / 30, rel=0.05)


def test_a_cut_in_a_file_is_not_waited_for_and_one_that_starts_again_goes_on() -> None:
    pace, now = Pace(), 0.0
    stamps = [0.0, 0.03, 1000.0, 1000.03, 0.0, 0.03]
    for t in stamps:
        now += pace.lead(t, now, size=1, waiting=1e9)
    assert now < MAX_STEP + 0.15


def test_the_system_says_what_is_unread() -> None:
    reader, writer = os.pipe()
    try:
        assert unread(reader) == 0
        os.write(writer, b"12345")
        assert unread(reader) == (5 if os.name == "posix" else 0)
    finally:
        os.close(reader)
        os.close(writer)
    assert unread(reader) == unread(-1) == 0  # closed, as a pipe and as a socket
