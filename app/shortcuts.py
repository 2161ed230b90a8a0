"""The keys, what each does, and in which words the help says so."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto


class Action(Enum):
    """What a key or a menu item asks for."""

    OPEN = auto()
    DRIVE = auto()
    IDLE = auto()
    SCREENSHOT = auto()
    RECORD = auto()
    QUIT = auto()
    CLOSE = auto()
    PLAY = auto()
    NEXT = auto()
    PREVIOUS = auto()
    REWIND = auto()
    LOOP = auto()
    FASTER = auto()
    SLOWER = auto()
    SMOOTH = auto()
    RESET_VIEW = auto()
    RESET_FACE = auto()
    NEUTRAL_FACE = auto()
    RANDOM_FACE = auto()
    NEXT_DEFORMER = auto()
    PANELS = auto()
    SIDEBAR = auto()
    FULLSCREEN = auto()
    VSYNC = auto()
    HELP = auto()


@dataclass(frozen=True)
class Shortcut:
    """A key: glfw's name for it (`KEY_` left out), with `ctrl` where the system's command key is held."""

    action: Action
    key: str
    shown: str
    text: str
    ctrl: bool = False
    repeats: bool = False


SHORTCUTS: dict[str, tuple[Shortcut, ...]] = {
    "Playing": (
        Shortcut(Action.PLAY, "SPACE", "Space", "Play or pause"),
        Shortcut(Action.PREVIOUS, "LEFT", "Left", "One frame back", repeats=True),
        Shortcut(Action.NEXT, "RIGHT", "Right", "One frame on", repeats=True),
        Shortcut(Action.REWIND, "HOME", "Home", "To the start"),
        Shortcut(Action.LOOP, "L", "L", "Repeat, or stop at the end"),
        Shortcut(Action.SLOWER, "LEFT_BRACKET", "[", "Slower"),
        Shortcut(Action.FASTER, "RIGHT_BRACKET", "]", "Faster"),
        Shortcut(Action.SMOOTH, "M", "M", "Smooth motion between frames"),
    ),
    "Face": (
        Shortcut(Action.RANDOM_FACE, "N", "N", "A random face"),
        Shortcut(Action.NEUTRAL_FACE, "0", "0", "The neutral face"),
        Shortcut(Action.RESET_FACE, "BACKSPACE", "Backspace", "Let go of every slider"),
        Shortcut(Action.NEXT_DEFORMER, "D", "D", "Next deformer"),
    ),
    "View": (
        Shortcut(Action.RESET_VIEW, "R", "R", "Reset the camera"),
        Shortcut(Action.PANELS, "H", "H", "Hide or show everything but the face"),
        Shortcut(Action.SIDEBAR, "TAB", "Tab", "Hide or show the sidebar"),
        Shortcut(Action.FULLSCREEN, "F11", "F11", "Full screen"),
    ),
    "Files": (
        Shortcut(Action.OPEN, "O", "Ctrl+O", "Open an avatar, a clip, a sound or a picture", ctrl=True),
        Shortcut(Action.DRIVE, "L", "Ctrl+L", "Listen to a live source", ctrl=True),
        Shortcut(Action.SCREENSHOT, "S", "S", "Screenshot"),
        Shortcut(Action.RECORD, "V", "V", "Start or stop a recording"),
        Shortcut(Action.QUIT, "Q", "Q", "Quit"),
        Shortcut(Action.HELP, "F1", "F1", "This list"),
    ),
}
"""Group of the help -> its keys."""
POINTER = (
    ("Drag", "Turn"),
    ("Right drag, or Shift", "Move"),
    ("Wheel, two fingers", "Nearer, further"),
    ("Shift and two fingers", "Move"),
    ("Right click on a slider", "Let go of it"),
    ("Ctrl and click on it", "Type a number"),
)
"""What the pointer does, for the help."""

HIDDEN = (
    Shortcut(Action.QUIT, "Q", "Ctrl+Q", "Quit", ctrl=True),
    Shortcut(Action.CLOSE, "ESCAPE", "Escape", "Close what is open, else quit"),
    Shortcut(Action.HELP, "SLASH", "?", "This list"),
)
"""Further keys, for those who expect them."""


def action_of(key: str, *, ctrl: bool, repeated: bool = False) -> Action | None:
    """What a key asks for.

    Args:
        key: glfw's name, `KEY_` left out.
        ctrl: The system's command key is held.
        repeated: It has been down for a while.
    """
    for shortcut in (*(s for group in SHORTCUTS.values() for s in group), *HIDDEN):
        if (shortcut.key, shortcut.ctrl) == (key, ctrl) and (shortcut.repeats or not repeated):
            return shortcut.action
    return None


def shown_key(action: Action) -> str:
    """The key of an action, for a menu; empty where there is none."""
    found = (s.shown for group in SHORTCUTS.values() for s in group if s.action is action)
    return next(found, "")
