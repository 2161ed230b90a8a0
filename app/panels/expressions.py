"""Every expression of the rig as a bar to drag, in groups, with a search."""

from __future__ import annotations

import numpy as np
from cap4d.app.expressions import Expression, grouped, matching
from cap4d.app.panels.widgets import ImVec2, bar, bare_button, quiet, section, tip
from cap4d.app.shortcuts import Action, shown_key
from cap4d.app.theme import HELD, QUIET, Icon, icon
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

BUTTONS = (
    (Action.RANDOM_FACE, Icon.RANDOM, "Random"),
    (Action.NEUTRAL_FACE, Icon.NEUTRAL, "Neutral"),
    (Action.RESET_FACE, Icon.RESET, "Reset"),
)


class ExpressionsPanel:
    """A touched bar takes its expression over from what plays, until it is let go."""

    title = "Face"

    def __init__(self) -> None:
        self.words = ""

    def draw(self, viewer: Viewer) -> None:
        self._draw_buttons(viewer)
        imgui.set_next_item_width(-1)
        hint = f"Search {len(viewer.expressions)} expressions"
        _, self.words = imgui.input_text_with_hint("##search", hint, self.words)
        if imgui.begin_child("expressions"):
            self._draw_groups(viewer)
        imgui.end_child()

    def _draw_buttons(self, viewer: Viewer) -> None:
        spacing = imgui.get_style().item_spacing.x
        width = (imgui.get_content_region_avail().x - 2 * spacing) / len(BUTTONS)
        for i, (action, symbol, text) in enumerate(BUTTONS):
            if i:
                imgui.same_line()
            held = action is Action.RESET_FACE and viewer.overrides.count
            imgui.begin_disabled(action is Action.RESET_FACE and not held)
            words = f"{icon(symbol)}  {text} {held}" if held else f"{icon(symbol)}  {text}"
            if imgui.button(f"{words}###{action.name}", ImVec2(width, 0)):
                viewer.act(action)
            imgui.end_disabled()
            tip(f"{shown_key(action)}")

    def _draw_groups(self, viewer: Viewer) -> None:
        found = matching(viewer.expressions, self.words)
        if not found:
            quiet("No expression is called that.")
        playing = viewer.frame().expr
        for group, expressions in grouped(found).items():
            if section(f"{group}###{group}"):
                imgui.push_id(group)
                for expression in expressions:
                    _draw_expression(viewer, expression, playing)
                imgui.pop_id()
                imgui.spacing()


def _draw_expression(viewer: Viewer, expression: Expression, playing: np.ndarray) -> None:
    overrides, index = viewer.overrides, expression.index
    held = bool(overrides.held[index])
    room = imgui.get_content_region_avail().x
    button = imgui.get_frame_height()
    value = bar(
        expression.name,
        expression.label,
        float(playing[index]),
        expression.low,
        expression.high,
        held=held,
        width=room - button - 2 if held else room,
    )
    let_go = imgui.is_item_clicked(imgui.MouseButton_.right)
    if value is not None:
        overrides.hold(index, value)
    if held:
        imgui.same_line(0, 2)
        let_go |= bare_button(
            f"{icon(Icon.CLOSE)}##{index}", size=(button, 0), color=QUIET if not let_go else HELD
        )
    if let_go:
        overrides.let_go(index)
