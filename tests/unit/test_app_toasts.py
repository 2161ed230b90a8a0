"""Messages come, are counted and go."""

import pytest
from cap4d.app.toasts import ERROR_SECONDS, FADE_SECONDS, KEPT, LONGEST, SECONDS, Toasts, Tone

from cap4d.errors import ArgumentError


def test_a_message_stays_a_while_fades_and_goes():
    toasts = Toasts()
    toasts.say("hello", 10.0)
    (toast,) = toasts.current(10.0)
    assert (toast.text, toast.tone, toast.opacity(10.0)) == ("hello", Tone.INFO, 1.0)
    assert toast.opacity(10 + SECONDS - FADE_SECONDS / 2) == pytest.approx(0.5)
    assert toasts.next_change(10.0) == pytest.approx(10 + SECONDS - FADE_SECONDS)
    assert toasts.current(10 + SECONDS) == []
    assert toasts.next_change(99.0) == float("inf")


def test_an_error_stays_longer_and_says_its_line():
    toasts = Toasts()
    toasts.fail(ArgumentError("size: expected\n more"), 0.0)
    toasts.fail(ValueError(), 0.0)
    texts = [t.text for t in toasts.current(ERROR_SECONDS - 0.1)]
    assert texts == ["size: expected more", "ValueError"]


def test_what_repeats_is_counted_and_not_stacked():
    toasts = Toasts()
    for i in range(100):
        toasts.say("again", i / 10)
    (toast,) = toasts.current(10.0)
    assert toast.count == 100


def test_the_oldest_gives_way_and_no_message_is_long():
    toasts = Toasts()
    for i in range(10):
        toasts.say(f"{i} " + "x" * 10_000, 0.0)
    current = toasts.current(0.0)
    assert [t.text[0] for t in current] == [str(i) for i in range(10 - KEPT, 10)]
    assert max(len(t.text) for t in current) == LONGEST


def test_a_message_can_be_dismissed():
    toasts = Toasts()
    toasts.say("a", 0.0)
    toasts.say("b", 0.0)
    toasts.dismiss(toasts.current(0.0)[0])
    assert [t.text for t in toasts.current(0.0)] == ["b"]
