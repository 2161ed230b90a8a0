"""Short messages that come, stay a while and go. Pure: callers pass the time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

SECONDS = 5.0  # that a message stays
ERROR_SECONDS = 9.0
FADE_SECONDS = 0.3
KEPT = 4  # messages at a time; the oldest gives way
LONGEST = 400  # characters


class Tone(Enum):
    """How a message is meant."""

    INFO = auto()
    ERROR = auto()


@dataclass(frozen=True)
class Toast:
    """One message.

    Args:
        text: For the user.
        until: When it goes, s.
        count: How often it was said.
    """

    text: str
    tone: Tone
    until: float
    count: int = 1

    def opacity(self, now: float) -> float:
        """1, and less as it goes."""
        return min(max((self.until - now) / FADE_SECONDS, 0.0), 1.0)


class Toasts:
    """The messages on screen, the newest last. One that repeats is counted, not stacked."""

    def __init__(self) -> None:
        self._toasts: list[Toast] = []

    def say(self, text: str, now: float, *, tone: Tone = Tone.INFO) -> None:
        """Shows `text`."""
        text = " ".join(text.split())[:LONGEST]
        until = now + (ERROR_SECONDS if tone is Tone.ERROR else SECONDS)
        said = next((t.count for t in self.current(now) if (t.text, t.tone) == (text, tone)), 0)
        others = [t for t in self._toasts if (t.text, t.tone) != (text, tone)]
        self._toasts = [*others, Toast(text, tone, until, said + 1)][-KEPT:]

    def fail(self, error: BaseException, now: float) -> None:
        """Shows an error's line."""
        self.say(str(error) or type(error).__name__, now, tone=Tone.ERROR)

    def dismiss(self, toast: Toast) -> None:
        """The user has read it."""
        self._toasts = [t for t in self._toasts if t is not toast]

    def current(self, now: float) -> list[Toast]:
        """What is to be seen at `now`."""
        self._toasts = [t for t in self._toasts if t.until > now]
        return list(self._toasts)

    def next_change(self, now: float) -> float:
        """When the picture of them next changes: at once while one fades, `inf` without any."""
        starts = [max(t.until - FADE_SECONDS, now) for t in self.current(now)]
        return min(starts, default=float("inf"))
