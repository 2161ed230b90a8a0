"""Where the eyes look, how the neck bends and how the head is turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from cap4d.app.overrides import HEAD
from cap4d.app.panels.widgets import bar, bare_button, section
from cap4d.app.theme import QUIET, Icon, icon
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui


@dataclass(frozen=True)
class Turn:
    """A rotation and its bars: (label, axis, most degrees); x nods, y turns, z tilts.

    Args:
        driver: The joint driver that it needs; None needs none.
    """

    name: str
    title: str
    driver: str | None
    axes: tuple[tuple[str, int, float], ...]


TURNS = (
    Turn("eye_rot", "Gaze", "eyes", (("Up, down", 0, 30), ("Left, right", 1, 40))),
    Turn("neck_rot", "Neck", "neck", (("Nod", 0, 35), ("Turn", 1, 45), ("Tilt", 2, 30))),
    Turn("jaw_rot", "Jaw", "jaw", (("Open", 0, 25), ("Sideways", 1, 12))),
    Turn(HEAD, "Head", None, (("Nod", 0, 60), ("Turn", 1, 90), ("Tilt", 2, 45))),
)


class PosePanel:
    """Bars in degrees."""

    title = "Pose"

    def draw(self, viewer: Viewer) -> None:
        drivers = viewer.loaded.bundle.subject.joint_drivers
        for turn in TURNS:
            if (turn.driver is None or turn.driver in drivers) and section(turn.title):
                imgui.push_id(turn.name)
                _draw_turn(viewer, turn)
                imgui.pop_id()
                imgui.spacing()


def _draw_turn(viewer: Viewer, turn: Turn) -> None:
    overrides = viewer.overrides
    held = turn.name in overrides.turns
    degrees = np.degrees(_current(viewer, turn.name))
    for label, axis, most in turn.axes:
        width = imgui.get_content_region_avail().x
        value = bar(
            label,
            label,
            float(degrees[axis]),
            -most,
            most,
            held=held,
            width=width,
            number="%.0f\N{DEGREE SIGN}",
        )
        if value is not None:
            degrees[axis] = value
            overrides.hold_turn(turn.name, np.radians(degrees))
        if imgui.is_item_clicked(imgui.MouseButton_.right):
            overrides.let_turn_go(turn.name)
    if held and bare_button(f"{icon(Icon.RESET)}  Let go", color=QUIET):
        overrides.let_turn_go(turn.name)


def _current(viewer: Viewer, name: str) -> np.ndarray:
    """[3] axis-angle, rad."""
    if name == HEAD:
        return viewer.overrides.turns.get(HEAD, np.zeros(3, np.float32)).copy()
    return np.array(getattr(viewer.frame(), name), np.float32)
