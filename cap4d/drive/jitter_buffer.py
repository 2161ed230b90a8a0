"""Frames as they arrive -> frames as they are due: the buffer between a network and a display.

It plays the stream's own clock, `transit.Transit.target` behind the frames' arrival. When the depth has to
change it plays up to a tenth faster or slower, so that no moment is jumped over or seen twice; while nothing
moves on screen anyway, because frames are missing, it waits for as long as it takes at once. Memory is
bounded: `MAX_FRAMES` frames, each kept for a second after it was due, to tell a duplicate from a late one.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from cap4d.drive.clip import Frame
from cap4d.drive.counts import Counts
from cap4d.drive.packet import Cause
from cap4d.drive.sample import mix
from cap4d.drive.transit import Transit

SLEW = 0.1  # of the stream's speed
MAX_FRAMES = 1024
KEPT = 1.0  # s
STAND = 0.05  # s
BRIDGE = 0.25  # s between frames up to which they are interpolated
NEW_CLOCK, NEW_CLOCK_TIME = 4, 0.05  # frames, and s of them, that agree on a jump of the clock
AGREE = 0.1  # s
MAX_DOUBTED = 64
NOISE = 0.05  # of the way from picture to picture: less is no turn
LOOK_BACK = 8  # frames in which a weight that stands still may have come to do so
NOWHERE = float("-inf")


@dataclass(eq=False)
class _Entry:
    t: float
    arrival: float
    ready: float
    frame: Frame
    done: bool = False  # counted as shown or as dropped


@dataclass(frozen=True, eq=False)
class Moment:
    """What is due.

    Args:
        frame: At this moment of the stream.
        flows: Whether the stream goes on from here; if not, `frame` is the last before the gap.
        mixed: Whether `frame` lies between two that came.
        arrival: When what is shown arrived, s: between two arrivals as the moment lies between two stamps.
    """

    frame: Frame
    flows: bool
    mixed: bool
    arrival: float


class JitterBuffer:
    """Holds frames until they are due. Not for two threads at once.

    Args:
        counts: Gets every frame that is refused.
    Attributes:
        shown, dropped: Frames that were on screen, in whole or in part; and those that newer ones overtook.
        overdue: Frames that came after their moment and were taken, as nothing newer was there.
        clocks: How often the sender's clock was taken up: once, and once more for each jump of it.
    """

    def __init__(self, counts: Counts) -> None:
        self.counts, self.transit = counts, Transit()
        self.shown = self.dropped = self.overdue = self.clocks = 0
        self._entries: list[_Entry] = []  # by stamp
        self._doubted: list[_Entry] = []  # perhaps of another clock; as they came
        self._offset = 0.0  # s: moment t is due at t + offset
        self._position = NOWHERE  # the moment on screen
        self._expr: np.ndarray | None = None  # and its weights
        self._now = NOWHERE
        self._stood = 0.0  # s for which the clock was stopped in this gap
        self._dry = True

    @property
    def waiting(self) -> int:
        """Frames whose fate is open."""
        return len(self._doubted) + sum(not entry.done for entry in self._entries)

    @property
    def depth(self) -> float:
        """s that a frame waits here: the middle one of the recent ones."""
        return self._offset - self.transit.median if len(self.transit) else 0.0

    def push(self, frame: Frame, arrival: float, ready: float | None = None) -> None:
        """A frame that arrived, at `arrival` s on the display's clock.

        Args:
            ready: When it had been converted, s; what is waited for. None: at once.
        """
        ready = arrival if ready is None else ready
        entry = _Entry(frame.t, arrival, ready, frame)
        if self.transit.is_stale(ready):
            self._settle()
            self._restart([entry])
        elif self.transit.fits(entry.t, ready):
            self._settle()
            self._insert(entry)
        elif any(other.t == entry.t for other in self._doubted):
            self._refuse(Cause.DUPLICATE)
        else:
            self._doubt(entry)

    def sample(self, now: float) -> Moment | None:
        """What is due at `now`; None before the first frame is."""
        self._slew(now)
        due = max(self._position, now - self._offset)
        at = self._after(due)
        if at == 0:
            return None
        before, after = self._entries[at - 1], self._entries[at] if at < len(self._entries) else None
        mixed = after is not None and before.t < due and after.t - before.t <= BRIDGE
        moment = _between(before, after, due) if mixed else Moment(before.frame, True, False, before.arrival)
        passed = range(self._after(self._position), at)
        moment = replace(moment, frame=self._with_turns(moment.frame, passed))
        self._show([before, after] if mixed else [before])
        self._drop(self._entries[i] for i in passed)
        self._dry = not mixed and before.t < due
        self._stand(due - before.t if self._dry else 0.0)
        self._position, self._expr = before.t if self._dry else due, moment.frame.expr
        self._forget(self._position - KEPT)
        return replace(moment, flows=not self._dry)

    def _slew(self, now: float) -> None:
        """Lets the depth follow its target."""
        elapsed = max(now - self._now, 0.0) if self._now > NOWHERE else 0.0
        self._now = max(self._now, now)
        longer = float("inf") if self._dry else SLEW * elapsed
        shorter = float("inf") if self._position == NOWHERE else SLEW * elapsed
        self._offset += min(max(self.transit.target - self._offset, -shorter), longer)

    def _stand(self, gone: float) -> None:
        """Stops the stream's clock for a frame that is missing: no more than for `STAND` s a gap.

        It would otherwise jump when the next frame comes; so it catches up by the slew.
        """
        step = min(gone, STAND - self._stood)
        self._offset += step
        self._stood = self._stood + step if gone else 0.0

    def _with_turns(self, frame: Frame, passed: range) -> Frame:
        """Puts the turning points that lie between the last picture and this one into this one.

        A blink is a few frames long: a display halfway between two of them, or one that shows every second,
        would never show the eye closed. So a weight that turned round at a frame since the last picture is
        shown as it was there, at the turn furthest from the last picture; the same keeps the moment in which
        lips touch. A turn that the way from picture to picture dwarfs is noise, and left out.
        """
        last, now = self._expr, frame.expr
        if last is None or not passed:
            return frame
        expr, furthest = now, NOISE * np.abs(now - last)
        for k, here in self._turns(passed):
            far = np.abs(here - last)
            at_turn = ~np.isnan(here) & (np.minimum(far, np.abs(here - now)) > 0) & (far > furthest)
            if at_turn.any():
                expr, furthest = np.where(at_turn, here, expr), np.where(at_turn, far, furthest)
                self._show([self._entries[k]])
        return replace(frame, expr=expr)

    def _turns(self, passed: range) -> Iterator[tuple[int, np.ndarray]]:
        """Frames at which weights turn round: (index, weights, with nan for those that go on)."""
        first = max(passed.start - LOOK_BACK, 0)
        values = np.stack([entry.frame.expr for entry in self._entries[first : passed.stop + 1]])
        steps = np.sign(np.diff(values, axis=0))
        course = np.zeros_like(values[0])  # the last way a weight went; it may have stood since
        for at, step in enumerate(steps, first):
            if at >= passed.start:
                yield at, np.where(course * step < 0, values[at - first], np.float32(np.nan))
            course = np.where(step != 0, step, course)

    def _insert(self, entry: _Entry) -> None:
        """Puts a frame of this clock in its place, if its moment is still to come."""
        at = self._after(entry.t)
        if at and self._entries[at - 1].t == entry.t:
            return self._refuse(Cause.DUPLICATE)
        self.transit.add(entry.t, entry.ready)
        if entry.t <= self._position:
            return self._refuse(Cause.LATE)
        self.overdue += entry.t < entry.ready - self._offset and self._position > NOWHERE
        self._entries.insert(at, entry)
        if len(self._entries) > MAX_FRAMES:
            self._drop(self._entries[:1])
            del self._entries[0]
        return None

    def _doubt(self, entry: _Entry) -> None:
        """A frame whose stamp does not fit: a jump of the clock, if the next ones agree."""
        if self._doubted and abs(_transit(entry) - _transit(self._doubted[-1])) > AGREE:
            self._settle()
        self._doubted.append(entry)
        if len(self._doubted) >= NEW_CLOCK and entry.ready - self._doubted[0].ready >= NEW_CLOCK_TIME:
            self._restart(self._doubted)
        elif len(self._doubted) > MAX_DOUBTED:
            self._settle()

    def _settle(self) -> None:
        """The clock did not jump: frames in doubt are late, or their stamps make no sense."""
        doubted, self._doubted = self._doubted, []
        for entry in doubted:
            if _transit(entry) > self.transit.median:
                self._insert(entry)
            else:
                self._refuse(Cause.TIME)

    def _restart(self, entries: list[_Entry]) -> None:
        """Takes up another clock, of which these are the first frames."""
        self._drop(self._entries)
        self._entries, self._doubted = sorted(entries, key=lambda entry: entry.t), []
        self._position, self._expr, self._dry = NOWHERE, None, True
        self.clocks += 1
        self.transit.clear()
        for entry in entries:
            self.transit.add(entry.t, entry.ready)

    def _after(self, t: float) -> int:
        """Index of the first frame later than `t`."""
        return bisect.bisect_right(self._entries, t, key=lambda entry: entry.t)

    def _forget(self, t: float) -> None:
        """Lets go of frames before `t`, but for the last."""
        del self._entries[: max(self._after(t) - 1, 0)]

    def _show(self, entries: Iterable[_Entry]) -> None:
        for entry in entries:
            self.shown += not entry.done
            entry.done = True

    def _drop(self, entries: Iterable[_Entry]) -> None:
        for entry in entries:
            self.dropped += not entry.done
            entry.done = True

    def _refuse(self, cause: Cause) -> None:
        self.counts.reject(cause, received=True)


def _between(a: _Entry, b: _Entry, t: float) -> Moment:
    blend = (t - a.t) / (b.t - a.t)
    frame = replace(mix(a.frame, b.frame, blend), t=t)
    return Moment(frame, True, True, a.arrival + blend * (b.arrival - a.arrival))


def _transit(entry: _Entry) -> float:
    return entry.ready - entry.t
