"""What drives the avatar, behind one protocol: a clip, which can be steered, or a live stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from cap4d.app.play_clock import PlayClock

from cap4d.drive.clip import Clip, Frame
from cap4d.drive.sample import sample

SPEEDS = (0.1, 0.25, 0.5, 1.0, 1.5, 2.0)
DISPLAY_HZ = 60.0  # how often a live stream is looked at, where the display does not say
LIVE_HZ = 30.0  # pictures a second that a live stream should at least have


class Playback(Protocol):
    """A source of frames on the wall clock. `now` is seconds of `time.monotonic`.

    Attributes:
        name: What to call it on screen.
        is_live: Frames come by themselves: it cannot be paused, scrubbed or repeated.
        rig_name: Whose expressions come.
        dropped: Frames that were due and never shown.
    """

    name: str
    is_live: bool
    rig_name: str

    @property
    def dropped(self) -> int: ...

    @property
    def interval(self) -> float:
        """Seconds that there are for a picture."""
        ...

    def rewind(self, now: float) -> None:
        """To the first frame, if there is one."""
        ...

    def number(self, now: float) -> int:
        """Changes when there is something new to show, and only then."""
        ...

    def frame(self) -> Frame:
        """The frame that `number` last spoke of."""
        ...

    def due(self) -> float:
        """When to look again."""
        ...

    def shown(self, now: float) -> None:
        """The frame's picture is on screen."""
        ...

    def statistics(self) -> Mapping[str, Any]:
        """Counts of a live stream, for `--stats`; empty for a clip."""
        ...

    def close(self) -> None:
        """Ends what runs in the background."""
        ...


class ClipPlayback:
    """Plays a clip, by default again and again.

    Args:
        clip: What plays.
        now: The current time, s.
        name: What to call it on screen.
    """

    is_live = False

    def __init__(self, clip: Clip, now: float, *, name: str = "idle") -> None:
        self.clip, self.name, self.rig_name = clip, name, clip.rig_name
        self.loops = True
        self.clock = PlayClock(clip.fps, now)
        self._smooth_hz: float | None = None
        self._number = 0
        self.moves = 0  # how often it was put elsewhere than where it would have gone

    @property
    def dropped(self) -> int:
        return self.clock.dropped

    @property
    def interval(self) -> float:
        return 1 / (self.clock.fps * self.clock.speed)

    @property
    def speed(self) -> float:
        return self.clock.speed

    @property
    def is_paused(self) -> bool:
        return self.clock.paused

    @property
    def is_smooth(self) -> bool:
        """Whether pictures come at the display's rate, between the clip's frames."""
        return self._smooth_hz is not None

    @property
    def position(self) -> float:
        """Seconds from the clip's start, within its length."""
        seconds = self._number / self.clock.fps
        return seconds % self.clip.duration if self.loops else min(seconds, self._last)

    def number(self, now: float) -> int:
        """The frame due at `now`. At the end of a clip that does not loop it stops."""
        self._number = self.clock.index(now)
        if not self.loops and self._number >= self._last_number:
            self._number = self._last_number
            self.clock.seek(self._number, now)
            self.clock.paused = True
        return self._number

    def frame(self) -> Frame:
        if self._smooth_hz is None:
            return self.clip.frame(self._number)
        return sample(self.clip, self._number / self.clock.fps)

    def due(self) -> float:
        return self.clock.due()

    def shown(self, now: float) -> None:
        """See `Playback`."""

    def statistics(self) -> Mapping[str, Any]:
        return {}

    def close(self) -> None:
        """See `Playback`."""

    def toggle(self, now: float) -> None:
        """Plays or pauses; at the end of a clip that does not loop it starts over."""
        if self.is_paused and not self.loops and self._number >= self._last_number:
            self.seek(0.0, now)
        self.clock.toggle(now)

    def step(self, frames: int, now: float) -> None:
        """Pauses and moves by whole frames of the clip, round its ends if it loops."""
        self.clock.paused = True
        count = len(self.clip)
        index = int(self.position * self.clip.fps + 1e-6) + frames
        index = index % count if self.loops else min(max(index, 0), count - 1)
        self._move(index / self.clip.fps, now)

    def seek(self, seconds: float, now: float) -> None:
        """To a time of the clip, s; plays on from there, or stays paused."""
        self._move(min(max(seconds, 0.0), self._last), now)

    def rewind(self, now: float) -> None:
        """To the first frame."""
        self._move(0.0, now)

    def set_speed(self, speed: float, now: float) -> None:
        """`speed` seconds of the clip per second, within the ends of `SPEEDS`."""
        speed = min(max(speed, SPEEDS[0]), SPEEDS[-1])
        position = self.position
        self.clock.change_speed(speed, now)
        if self._smooth_hz is not None:
            self.clock.fps = self._smooth_hz / speed
        self._move(position, now)

    def set_loops(self, on: bool, now: float) -> None:
        """Whether it begins again at its end; the round that plays now goes on from where it is."""
        position = self.position
        self.loops = on
        self._move(position, now)

    def set_smooth(self, display_hz: float | None, now: float) -> None:
        """Interpolates to `display_hz` pictures a second; None shows the clip's own frames."""
        position = self.position
        self._smooth_hz = display_hz
        self.clock.fps = self.clip.fps if display_hz is None else display_hz / self.speed
        self._move(position, now)

    def follow(self, seconds: float, now: float) -> None:
        """Lets the sound, which has played `seconds`, set the clock."""
        if not self.is_paused:
            self.clock.follow(seconds, now)

    @property
    def _last(self) -> float:
        """Seconds at which the last frame starts."""
        return (len(self.clip) - 1) / self.clip.fps

    @property
    def _last_number(self) -> int:
        return int(self._last * self.clock.fps + 1e-6)

    def _move(self, seconds: float, now: float) -> None:
        self.moves += 1
        self._number = int(seconds * self.clock.fps + 1e-6)
        self.clock.seek(self._number, now)


class Stream(Protocol):
    """What of `cap4d.drive.live.LiveStream` a window needs; see there."""

    error: Exception | None

    @property
    def address(self) -> str: ...

    @property
    def state(self) -> str: ...

    def __enter__(self) -> Stream: ...

    def __exit__(self, *error: Any) -> None: ...

    def frame(self, now: float) -> Frame: ...

    def shown(self, now: float) -> None: ...

    def statistics(self) -> dict[str, Any]: ...


class StreamPlayback:
    """Plays what a live stream has at the display's rate, without a picture for what did not change.

    Args:
        stream: Starts now; closed with the playback.
        rig_name: The rig that its frames are converted to.
        display_hz: How often to look.
    """

    is_live = True

    def __init__(self, stream: Stream, *, rig_name: str, display_hz: float = DISPLAY_HZ) -> None:
        self.stream, self.rig_name, self.display_hz = stream.__enter__(), rig_name, display_hz
        self.is_closed = False
        self._frame: Frame | None = None
        self._number = -1
        self._looked = -np.inf

    @property
    def dropped(self) -> int:
        return int(self.stream.statistics().get("dropped", 0))

    @property
    def interval(self) -> float:
        return 1 / LIVE_HZ

    def rewind(self, now: float) -> None:
        """See `Playback`: there is none."""

    @property
    def name(self) -> str:
        return self.stream.address

    @property
    def error(self) -> Exception | None:
        """Why nothing comes any more, or None."""
        return self.stream.error

    @property
    def state(self) -> str:
        """`waiting`, `playing`, `holding` or `easing`."""
        return str(self.stream.state)

    def number(self, now: float) -> int:
        self._looked = now
        frame = self.stream.frame(now)
        if self._frame is None or not _same_pose(frame, self._frame):
            self._number += 1
        self._frame = frame
        return self._number

    def frame(self) -> Frame:
        assert self._frame is not None, "number comes first"
        return self._frame

    def due(self) -> float:
        return self._looked + 1 / self.display_hz

    def shown(self, now: float) -> None:
        self.stream.shown(now)

    def statistics(self) -> Mapping[str, Any]:
        return self.stream.statistics()

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            self.stream.__exit__(None, None, None)


def _same_pose(a: Frame, b: Frame) -> bool:
    names = ("expr", "eye_rot", "neck_rot", "jaw_rot", "rot", "tra")
    return all(_same(getattr(a, name), getattr(b, name)) for name in names)


def _same(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))
