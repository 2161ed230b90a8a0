"""Which frame of a clip is due now. Pure: callers pass the time, so that it can be tested without waiting."""

from __future__ import annotations


class PlayClock:
    """Plays frame after frame at `fps` on the wall clock. A slow player skips frames; it never slows down.

    Indices grow without end; a clip repeats by taking them modulo its length (`Clip.frame`).

    Args:
        fps: Frames per second of the clip's own time.
        now: The current time, s, on any clock that only goes forward.
        speed: Seconds of the clip per second; above 0.
    """

    def __init__(self, fps: float, now: float, *, speed: float = 1.0) -> None:
        self.fps, self.speed = fps, speed
        self.paused = False
        self.dropped = 0  # frames that were due and never shown
        self._start = now
        self._shown = -1

    def index(self, now: float) -> int:
        """The frame due at `now`; frames passed over since the last call count as dropped."""
        if self.paused:
            return max(self._shown, 0)
        due = max(int((now - self._start) * self._rate + 1e-6), self._shown, 0)
        self.dropped += max(due - self._shown - 1, 0)
        self._shown = due
        return due

    def due(self) -> float:
        """When the next frame is due."""
        return float("inf") if self.paused else self._start + (self._shown + 1) / self._rate

    def toggle(self, now: float) -> None:
        """Pauses, or goes on from the frame shown."""
        self.paused = not self.paused
        self._start_at(max(self._shown, 0), now)

    def seek(self, index: int, now: float) -> None:
        """To frame `index`, which is shown; plays on, or stays paused."""
        self._shown = max(index, 0)
        self._start_at(self._shown, now)

    def change_speed(self, speed: float, now: float) -> None:
        """Goes on from the frame shown at `speed` seconds of the clip per second."""
        self.speed = speed
        self._start_at(max(self._shown, 0), now)

    def follow(self, seconds: float, now: float) -> None:
        """Sets the clock by another one, on which `seconds` of the clip have passed."""
        self._start = now - seconds / self.speed

    @property
    def _rate(self) -> float:
        """Frames per second of the wall clock."""
        return self.fps * self.speed

    def _start_at(self, index: int, now: float) -> None:
        self._start = now - index / self._rate
