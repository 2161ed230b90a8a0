"""All panels of the window, laid out."""

from __future__ import annotations

from collections.abc import Sequence

from cap4d.app.layout import Layout
from cap4d.app.panels.dialog import Dialog
from cap4d.app.overlays.legend import Legend
from cap4d.app.panels.help import HelpPanel
from cap4d.app.panels.legends import draw_legends
from cap4d.app.panels.menu import Menu
from cap4d.app.panels.notes import Notes
from cap4d.app.panels.sidebar import Sidebar
from cap4d.app.panels.transport import Transport
from cap4d.app.viewer import Viewer


class Screen:
    """Draws what `Layout` gives a place, and what floats over it."""

    def __init__(self) -> None:
        self.menu, self.sidebar, self.transport = Menu(), Sidebar(), Transport()
        self.help, self.dialog, self.notes = HelpPanel(), Dialog(), Notes()

    def draw(self, viewer: Viewer, layout: Layout, legends: Sequence[Legend] = ()) -> None:
        if layout.menu is not None:
            self.menu.draw(viewer)
        if layout.sidebar is not None:
            self.sidebar.draw(viewer, layout.sidebar)
        if layout.transport is not None:
            self.transport.draw(viewer, layout.transport)
        draw_legends(legends, layout.picture)
        self.notes.draw(viewer, layout.picture)
        self.help.draw(viewer, layout.picture)
        self.dialog.draw(viewer, layout.picture)
