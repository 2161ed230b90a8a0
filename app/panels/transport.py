"""The bar under the picture: play, step, scrub, repeat, speed; or what a live source does; the cameras."""

from __future__ import annotations

from cap4d.app.layout import Rect
from cap4d.app.panels.widgets import FIXED, ImVec2, bare_button, lit_button, quiet, tip
from cap4d.app.playback import SPEEDS, ClipPlayback, Playback, StreamPlayback
from cap4d.app.shortcuts import Action, shown_key
from cap4d.app.theme import BAD, BAR, GOOD, HELD, QUIET, Color, Icon, icon
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui

STATES: dict[str, Color] = {"playing": GOOD, "holding": HELD, "easing": HELD, "waiting": QUIET}
WORDS = {"waiting": "waiting for a sender at", "easing": "the sender is silent:", "holding": "holding"}


class Transport:
    """Steers what drives the avatar."""

    def draw(self, viewer: Viewer, place: Rect) -> None:
        imgui.set_next_window_pos(ImVec2(place.x, place.y))
        imgui.set_next_window_size(ImVec2(place.width, place.height))
        imgui.push_style_color(imgui.Col_.window_bg, imgui.ImVec4(*BAR))
        imgui.push_style_var(
            imgui.StyleVar_.window_padding, ImVec2(10, (place.height - imgui.get_frame_height()) / 2)
        )
        if imgui.begin("transport", None, FIXED | imgui.WindowFlags_.no_scrollbar)[0]:
            if isinstance(viewer.playback, ClipPlayback):
                _draw_clip(viewer, viewer.playback)
            else:
                _draw_live(viewer, viewer.playback)
            _draw_cameras(viewer)
        imgui.end()
        imgui.pop_style_var()
        imgui.pop_style_color()


def clock_text(seconds: float) -> str:
    """`1:02.3`"""
    tenths = int(seconds * 10 + 1e-6)
    return f"{tenths // 600}:{tenths // 10 % 60:02d}.{tenths % 10}"


def _square() -> tuple[float, float]:
    return imgui.get_frame_height() * 1.25, 0


def _action(viewer: Viewer, action: Action, symbol: str, text: str, *, color: Color | None = None) -> None:
    if bare_button(f"{icon(symbol)}##{action.name}", size=_square(), color=color):
        viewer.act(action)
    tip(f"{text} ({shown_key(action)})")
    imgui.same_line(0, 2)


def _draw_clip(viewer: Viewer, playback: ClipPlayback) -> None:
    _action(viewer, Action.PREVIOUS, Icon.BACK, "One frame back")
    symbol, text = (Icon.PLAY, "Play") if playback.is_paused else (Icon.PAUSE, "Pause")
    _action(viewer, Action.PLAY, symbol, text)
    _action(viewer, Action.NEXT, Icon.FORWARD, "One frame on")
    _draw_scrubber(viewer, playback)
    imgui.same_line(0, 6)
    if lit_button(f"{icon(Icon.REPEAT)}##loop", playback.loops, size=_square()):
        viewer.act(Action.LOOP)
    tip(f"Repeat ({shown_key(Action.LOOP)})")
    imgui.same_line(0, 2)
    _draw_speed(viewer, playback)


def _draw_scrubber(viewer: Viewer, playback: ClipPlayback) -> None:
    length, position = playback.clip.duration, playback.position
    text = f"{clock_text(position)} / {clock_text(length)}"
    right = 4 * _square()[0] + imgui.calc_text_size("0.25 x").x + 84
    width = imgui.get_content_region_avail().x - right - imgui.calc_text_size(text).x - 12
    if width > 40:
        imgui.same_line(0, 8)
        imgui.set_next_item_width(width)
        moved, wanted = imgui.slider_float("##scrub", position, 0.0, length, "", imgui.SliderFlags_.no_input)
        if moved:
            playback.seek(wanted, viewer.now)
        tip(playback.name)
        imgui.same_line()
    imgui.align_text_to_frame_padding()
    quiet(text)


def _draw_speed(viewer: Viewer, playback: ClipPlayback) -> None:
    imgui.set_next_item_width(imgui.calc_text_size("0.25 x").x + 36)
    if imgui.begin_combo("##speed", f"{playback.speed:g} x"):
        for speed in SPEEDS:
            if imgui.selectable(f"{speed:g} x", speed == playback.speed)[0]:
                playback.set_speed(speed, viewer.now)
        imgui.end_combo()
    tip(f"Speed ({shown_key(Action.SLOWER)} {shown_key(Action.FASTER)})")


def _draw_live(viewer: Viewer, playback: Playback) -> None:
    state = playback.state if isinstance(playback, StreamPlayback) else "playing"
    color = STATES.get(state, BAD)
    imgui.align_text_to_frame_padding()
    imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*color))
    imgui.text_unformatted(f"{icon(Icon.LIVE)}  {WORDS.get(state, state)}")
    imgui.pop_style_color()
    imgui.same_line(0, 12)
    quiet(playback.name)
    imgui.same_line(0, 12)
    if imgui.button("Stop listening"):
        viewer.act(Action.IDLE)


def _draw_cameras(viewer: Viewer) -> None:
    side = _square()[0]
    recording = viewer.recording_since is not None
    text = clock_text(viewer.now - viewer.recording_since) if recording else ""
    width = 2 * side + 2 + (imgui.calc_text_size(text).x + 6 if recording else 0)
    imgui.same_line(imgui.get_window_width() - width - imgui.get_style().window_padding.x)
    if recording:
        imgui.align_text_to_frame_padding()
        quiet(text)
        imgui.same_line(0, 6)
    _action(viewer, Action.SCREENSHOT, Icon.PHOTO, "Screenshot")
    words = "Stop recording" if recording else "Record"
    _action(viewer, Action.RECORD, Icon.STOP if recording else Icon.RECORD, words, color=BAD)
