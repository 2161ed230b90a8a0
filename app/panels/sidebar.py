"""The panels at the right, one at a time behind tabs."""

from __future__ import annotations

from cap4d.app.layout import Rect
from cap4d.app.panels.expressions import ExpressionsPanel
from cap4d.app.panels.look import LookPanel
from cap4d.app.panels.pose import PosePanel
from cap4d.app.panels.timing import TimingPanel
from cap4d.app.panels.widgets import FIXED, ImVec2
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui


class Sidebar:
    """Tabs over one panel."""

    def __init__(self) -> None:
        self.panels = (ExpressionsPanel(), PosePanel(), LookPanel(), TimingPanel())
        self.wanted: str | None = None  # title of the tab to show next

    def draw(self, viewer: Viewer, place: Rect) -> None:
        imgui.set_next_window_pos(ImVec2(place.x, place.y))
        imgui.set_next_window_size(ImVec2(place.width, place.height))
        if imgui.begin("sidebar", None, FIXED)[0] and imgui.begin_tab_bar("tabs"):
            for panel in self.panels:
                flags = imgui.TabItemFlags_.set_selected if panel.title == self.wanted else 0
                if imgui.begin_tab_item(panel.title, None, flags)[0]:
                    self._draw_panel(viewer, panel)
                    imgui.end_tab_item()
            self.wanted = None
            imgui.end_tab_bar()
        imgui.end()

    def _draw_panel(
        self, viewer: Viewer, panel: ExpressionsPanel | PosePanel | LookPanel | TimingPanel
    ) -> None:
        imgui.spacing()
        if imgui.begin_child(panel.title):
            panel.draw(viewer)
        imgui.end_child()
