"""How it looks: the background, the deformer with its error, and how many pixels are drawn."""

from __future__ import annotations

from cap4d.app.background import WHITE, Checkerboard
from cap4d.app.panels.overlays import draw_overlays
from cap4d.app.panels.widgets import ImVec2, ImVec4, choice, quiet, section, tip
from cap4d.app.playback import ClipPlayback
from cap4d.app.quality import CHOICES
from cap4d.app.shortcuts import Action
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

SWATCHES = {
    "White": (1.0, 1.0, 1.0),
    "Light": (0.86, 0.87, 0.89),
    "Grey": (0.5, 0.5, 0.5),
    "Dark": (0.13, 0.14, 0.16),
    "Black": (0.0, 0.0, 0.0),
    "Green": (0.0, 0.69, 0.25),
}
TIERS = {
    "full": "Full",
    "fp16": "Half precision",
    "int8": "Whole numbers (int8)",
    "linear": "Linear",
    "off": "Off",
}
MICROMETRE = 1e-3  # mm: errors below it are rounding


class LookPanel:
    """Everything that changes the picture and not the face."""

    title = "Look"

    def draw(self, viewer: Viewer) -> None:
        if section("Background"):
            _draw_background(viewer)
            imgui.spacing()
        if section("Deformer"):
            _draw_deformers(viewer)
            imgui.spacing()
        if section("Overlays"):
            draw_overlays(viewer)
            imgui.spacing()
        if section("Quality"):
            _draw_quality(viewer)


def _draw_background(viewer: Viewer) -> None:
    height = imgui.get_frame_height()
    for name, color in SWATCHES.items():
        if imgui.color_button(
            name, ImVec4(*color, 1), imgui.ColorEditFlags_.no_tooltip, ImVec2(height, height)
        ):
            viewer.background = color
        tip(name)
        imgui.same_line()
    flags = imgui.ColorEditFlags_.no_inputs | imgui.ColorEditFlags_.no_label
    own = viewer.background if isinstance(viewer.background, tuple) else WHITE
    changed, color = imgui.color_edit3("##own", list(own), flags)
    if changed:
        viewer.background = tuple(float(c) for c in color)
    tip("Any colour")
    if imgui.radio_button("Transparent", isinstance(viewer.background, Checkerboard)):
        viewer.background = Checkerboard()
    tip("Screenshots keep their alpha")
    quiet("Drop an image here to put it behind.")


def _draw_deformers(viewer: Viewer) -> None:
    errors, tiers = viewer.loaded.bundle.tier_errors, viewer.loaded.tiers
    for i, tier in enumerate(tiers):
        note = "exact" if i == 0 else error_text(errors.get(tier))
        if choice(TIERS[tier], tier == viewer.avatar.tier, note) and tier != viewer.avatar.tier:
            viewer.choose_deformer(tier)
        if tier in errors and i:
            tip(f"{errors[tier][0]:.3f} mm root mean square, {errors[tier][1]:.2f} mm at most, from full")
    if len(tiers) > 2 and imgui.button("Choose for this machine"):
        viewer.choose_deformer("auto")


def error_text(error: tuple[float, float] | None) -> str:
    """A tier's measured error, e.g. `0.003 mm`."""
    if error is None:
        return "not measured"
    return "< 0.001 mm" if error[0] < MICROMETRE else f"{error[0]:.3f} mm"


def _draw_quality(viewer: Viewer) -> None:
    quality = viewer.quality
    names = ["Automatic", *(f"{choice:.0%} of the pixels' side" for choice in CHOICES)]
    current = 0 if quality.fixed is None else 1 + CHOICES.index(quality.fixed)
    imgui.set_next_item_width(-1)
    changed, picked = imgui.combo("##scale", current, names)
    if changed:
        quality.choose(None if picked == 0 else CHOICES[picked - 1])
    if quality.fixed is None:
        quiet(f"Now {quality.scale:.0%}: as many as keep up")
    if isinstance(viewer.playback, ClipPlayback):
        changed, _ = imgui.checkbox("Smooth motion between frames", viewer.playback.is_smooth)
        if changed:
            viewer.act(Action.SMOOTH)
