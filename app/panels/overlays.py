"""What can be laid over the face, to look at how it is made."""

from __future__ import annotations

from cap4d.app.overlays.overlays import Overlay, Part, why_not
from cap4d.app.panels.widgets import tip
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

NAMES = {
    Overlay.MESH: ("Mesh", "The triangles that carry the Gaussians"),
    Overlay.UV: ("UV grid", "Lines of equal texture coordinates"),
    Overlay.DENSITY: ("Gaussian density", "How many Gaussians a pixel has"),
    Overlay.DEFORMATION: ("Deformation", "How far the network moves each point"),
}
PARTS = {Part.ALL: "All of it", Part.EXPRESSION: "By the expression"}


def draw_overlays(viewer: Viewer) -> None:
    """A switch for each."""
    for overlay, (name, note) in NAMES.items():
        reason = why_not(overlay, viewer.avatar.bundle)
        imgui.begin_disabled(bool(reason))
        changed, on = imgui.checkbox(name, overlay in viewer.overlays and not reason)
        imgui.end_disabled()
        if changed:
            viewer.overlays = viewer.overlays | {overlay} if on else viewer.overlays - {overlay}
        tip(reason or note)
    if Overlay.DEFORMATION in viewer.overlays and not why_not(Overlay.DEFORMATION, viewer.avatar.bundle):
        for part, name in PARTS.items():
            imgui.same_line() if part is not Part.ALL else imgui.indent()
            if imgui.radio_button(name, viewer.overlay_part is part):
                viewer.overlay_part = part
        imgui.unindent()
