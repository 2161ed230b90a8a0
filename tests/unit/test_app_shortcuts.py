"""Keys and what they ask for."""

from collections import Counter

import glfw
from cap4d.app.shortcuts import HIDDEN, SHORTCUTS, Action, action_of, shown_key

ALL = [s for group in SHORTCUTS.values() for s in group] + list(HIDDEN)


def test_no_key_asks_for_two_things_and_every_key_exists():
    assert max(Counter((s.key, s.ctrl) for s in ALL).values()) == 1
    assert all(hasattr(glfw, f"KEY_{s.key}") for s in ALL)


def test_keys_are_found_with_and_without_ctrl():
    assert action_of("SPACE", ctrl=False) is Action.PLAY
    assert action_of("L", ctrl=False) is Action.LOOP
    assert action_of("L", ctrl=True) is Action.DRIVE
    assert action_of("Z", ctrl=False) is None


def test_only_stepping_repeats_while_a_key_is_down():
    assert action_of("RIGHT", ctrl=False, repeated=True) is Action.NEXT
    assert action_of("SPACE", ctrl=False, repeated=True) is None


def test_menus_show_the_key():
    assert shown_key(Action.OPEN) == "Ctrl+O"
    assert shown_key(Action.IDLE) == ""
