"""What mouse and keyboard do to the view and to what plays; knows no window system."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto

from cap4d.app.orbit import Orbit

MAX_SCROLL = 10.0  # steps that one event may turn the wheel


class Drag(Enum):
    """What moving the pointer does while a button is held."""

    TURN = auto()
    PAN = auto()


class Controls:
    """The state behind the window's input over the picture.

    Until the pointer first turns, zooms or pans, `orbit` is None and the camera follows the given path; reset
    gives it back to the path.

    Args:
        current_orbit: The view shown now, from which a first move starts.
    """

    def __init__(self, current_orbit: Callable[[], Orbit]) -> None:
        self.current_orbit = current_orbit
        self.orbit: Orbit | None = None
        self._drag: Drag | None = None
        self._pointer = (0.0, 0.0)

    def press(self, drag: Drag) -> None:
        """A button went down."""
        self._drag = drag

    def release(self) -> None:
        """The button went up."""
        self._drag = None

    def move(self, x: float, y: float, size: tuple[int, int]) -> None:
        """The pointer is at (x, y) of a picture of `size`, window units, y down."""
        dx, dy = x - self._pointer[0], y - self._pointer[1]
        self._pointer = x, y
        if self._drag is Drag.TURN:
            self.orbit = self._seen().turned(dx / max(size[1], 1), dy / max(size[1], 1))
        elif self._drag is Drag.PAN:
            self.pan(dx, dy, size)

    def scroll(self, steps: float) -> None:
        """The wheel turned away from the user by `steps`; a trackpad sends parts of them."""
        self.orbit = self._seen().zoomed(min(max(steps, -MAX_SCROLL), MAX_SCROLL))

    def pan(self, right: float, down: float, size: tuple[int, int]) -> None:
        """The picture is moved, window units."""
        side = max(min(size), 1)
        self.orbit = self._seen().panned(right / side, down / side)

    def reset(self) -> None:
        """Gives the camera back to its path."""
        self.orbit = None

    def _seen(self) -> Orbit:
        return self.orbit or self.current_orbit()
