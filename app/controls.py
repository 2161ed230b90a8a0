"""What mouse and keyboard do to the view; knows no window system."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto

from cap4d.app.orbit import Orbit
from cap4d.app.play_clock import PlayClock


class Drag(Enum):
    """What moving the pointer does while a button is held."""

    TURN = auto()
    PAN = auto()


class Controls:
    """The state behind the window's input.

    Until the pointer first turns, zooms or pans, `orbit` is None and the camera follows the given path; reset
    gives it back to the path.

    Args:
        clock: Paused, stepped and rewound by keys.
        current_orbit: The view shown now, from which a first move starts.
    """

    def __init__(self, clock: PlayClock, current_orbit: Callable[[], Orbit]) -> None:
        self.clock = clock
        self.current_orbit = current_orbit
        self.orbit: Orbit | None = None
        self.shows_hud = True
        self.quit = False
        self._drag: Drag | None = None
        self._pointer = (0.0, 0.0)

    def press(self, drag: Drag) -> None:
        """A button went down."""
        self._drag = drag

    def release(self) -> None:
        """The button went up."""
        self._drag = None

    def move(self, x: float, y: float, size: tuple[int, int]) -> None:
        """The pointer is at (x, y) of a window of `size`, window units, y down."""
        dx, dy = x - self._pointer[0], y - self._pointer[1]
        self._pointer = x, y
        orbit = self.orbit or self.current_orbit()
        if self._drag is Drag.TURN:
            self.orbit = orbit.turned(dx / size[1], dy / size[1])
        elif self._drag is Drag.PAN:
            self.orbit = orbit.panned(dx / min(size), dy / min(size))

    def scroll(self, steps: float) -> None:
        """The wheel turned away from the user by `steps`."""
        self.orbit = (self.orbit or self.current_orbit()).zoomed(steps)

    def key(self, name: str, now: float) -> None:
        """A key went down: space, r, left, right, h, escape or q."""
        match name:
            case "space":
                self.clock.toggle(now)
            case "r":
                self.orbit = None
                self.clock.rewind(now)
            case "left":
                self.clock.step(-1)
            case "right":
                self.clock.step(1)
            case "h":
                self.shows_hud = not self.shows_hud
            case "escape" | "q":
                self.quit = True
