"""Playing in a window: draws what is due, and the panels over it; sleeps while nothing changes."""

from __future__ import annotations

import logging
import time
from collections.abc import Hashable
from contextlib import ExitStack
from pathlib import Path

import moderngl
from cap4d.app.background import Backdrop, Background
from cap4d.app.canvas import Canvas
from cap4d.app.gl_context import is_software
from cap4d.app.layout import Layout, share_out
from cap4d.app.loading import load_avatar, open_playback
from cap4d.app.options import Options
from cap4d.app.overlays.overlays import Overlays
from cap4d.app.recent import RecentFiles, config_folder
from cap4d.app.renderers import CpuRenderer, GlRenderer, Renderer
from cap4d.app.shortcuts import Action
from cap4d.app.taking import Taking
from cap4d.app.viewer import Viewer
from cap4d.app.window import Window

from cap4d.camera import Camera
from cap4d.player.avatar import Avatar
from cap4d.player.offline import statistics, write_stats
from cap4d.player.sound import Sound

log = logging.getLogger(__name__)

IDLE_SECONDS = 0.25  # the longest sleep of a window that shows nothing new
BUSY_SECONDS = 0.02  # the longest while something is done in the background
LEFT_OVER = (0.095, 0.100, 0.113)  # behind the panels


def play_live(path: Path, options: Options, window: Window) -> None:
    """Plays the avatar at `path` until the window is closed, or for `options.frames` pictures.

    Raises:
        ArgumentError, DataError: The avatar or what drives it is not sound.
    """
    viewer = open_viewer(path, options)
    player = LivePlayer(window, viewer, options.backend)
    try:
        player.run(options.frames)
        _write_stats(player, options)
    except KeyboardInterrupt:  # a live source is often ended so: what was measured counts
        _write_stats(player, options)
        raise
    finally:
        player.close()


def _write_stats(player: LivePlayer, options: Options) -> None:
    if options.stats is not None:
        write_stats(options.stats, player.statistics())


def open_viewer(path: Path, options: Options) -> Viewer:
    """What the command line asks for, ready to be shown.

    Raises:
        ArgumentError, DataError: See `play_live`.
    """
    loaded = load_avatar(path, options.deformer)
    playback = open_playback(options.drive, loaded.bundle, **options.driving)
    loaded.avatar.check_rig(playback.rig_name)
    viewer = Viewer(
        loaded,
        playback,
        fill=options.fill,
        sender=options.sender,
        camera=options.camera,
        deformer=options.deformer,
        recent=RecentFiles(config_folder() / "recent.json"),
        is_welcome=options.avatar is None,
    )
    if options.avatar is not None:
        viewer.recent.add(options.avatar)
    if options.audio is not None:
        viewer.set_sound(Sound.load(options.audio))
    return viewer


def choose_renderer(wanted: str, ctx: moderngl.Context, avatar: Avatar) -> Renderer:
    """`auto` is OpenGL unless a software driver stands behind it, which the CPU renderer beats."""
    if wanted == "cpu" or (wanted == "auto" and is_software(ctx)):
        return CpuRenderer(ctx, avatar)
    return GlRenderer(ctx, avatar)


class LivePlayer:
    """A viewer in a window.

    Args:
        window: Where to draw.
        viewer: What.
        backend: See `choose_renderer`.
    """

    def __init__(self, window: Window, viewer: Viewer, backend: str = "auto") -> None:
        from cap4d.app.gui import Gui
        from cap4d.app.input import Input
        from cap4d.app.panels.screen import Screen

        self.window, self.viewer, self.backend = window, viewer, backend
        self.renderer = choose_renderer(backend, window.ctx, viewer.avatar)
        self.backdrop, self.canvas = Backdrop(window.ctx), Canvas(window.ctx)
        self.overlays = Overlays(window.ctx, viewer.avatar)
        self.taking = Taking(viewer)
        self.gui, self.screen = Gui(window.ctx, scale=window.scale, clipboard=window), Screen()
        self.input = Input(self.gui, viewer)
        self.picture: moderngl.Texture | None = None
        self.camera: Camera | None = None  # of the picture
        self.shown: Hashable = None  # what the picture on screen depends on
        self.frames = self.late = 0
        self.started = self.swapped = viewer.now
        viewer.display_hz = window.refresh_rate
        window.connect(self.input)

    def run(self, frames: int | None) -> None:
        """Draws until the window closes, the user quits, or `frames` pictures were shown."""
        while not (self.window.should_close or self.frames == frames):
            self.window.poll()
            if not self.step():
                self.window.wait(self._pause())

    def close(self) -> None:
        """Ends what runs in the background, and Dear ImGui."""
        with ExitStack() as stack:  # all of it, even where a recording cannot be finished
            stack.callback(self.gui.release)
            stack.callback(self.viewer.close)
            self.taking.close()

    def step(self) -> bool:
        """Shows what has changed; False if all of it is on screen already, or the window has no pixels."""
        viewer = self.viewer
        if viewer.poll():
            self.gui.touch()
        self._obey()
        if min(self.window.framebuffer_size) < 1:
            return False
        layout, start = self._layout(), time.perf_counter()
        is_new = self._draw_picture(layout)
        if viewer.has_news:
            viewer.has_news = False
            self.gui.touch()
        if not (is_new or self.gui.is_moving or viewer.toasts.next_change(viewer.now) <= viewer.now):
            return False
        self._show(layout, is_new)
        if is_new and self.renderer.name == "cpu":
            viewer.quality.picture_took(time.perf_counter() - start, viewer.playback.interval)
        self.window.swap()
        if is_new:
            self._count()
        return True

    def statistics(self) -> dict:
        """What `--stats` writes."""
        playback = self.viewer.playback
        found = statistics(
            self.viewer.avatar,
            self.frames,
            self.viewer.now - self.started,
            size=self.window.framebuffer_size,
            backend=self.renderer.name,
            dropped=playback.dropped,
            late=self.late,
        )
        return found | ({"drive": dict(playback.statistics())} if playback.is_live else {})

    def _layout(self) -> Layout:
        viewer = self.viewer
        layout = share_out(
            self.window.size, self.gui.scale, panels=viewer.shows_panels, sidebar=viewer.shows_sidebar
        )
        self.input.picture_size = layout.picture.width, layout.picture.height
        return layout

    def _place(self, layout: Layout) -> tuple[int, int, int, int]:
        """(left, bottom, width, height) px of the picture in the window."""
        return layout.picture.in_pixels(self.window.size, self.window.framebuffer_size)

    def _picture_size(self, layout: Layout) -> tuple[int, int]:
        """The CPU draws the window's own units, however many pixels a display has to each, or fewer."""
        if self.renderer.name == "cpu":
            scale = self.viewer.quality.scale
            return max(round(layout.picture.width * scale), 1), max(round(layout.picture.height * scale), 1)
        *_, width, height = self._place(layout)
        return max(width, 1), max(height, 1)

    def _draw_picture(self, layout: Layout) -> bool:
        """Draws the face if it is not the one on screen; an error is said, and the window goes on."""
        viewer, size = self.viewer, self._picture_size(layout)
        if viewer.is_settling and self.picture is not None:
            return False
        try:
            wanted = viewer.number(), size
            if wanted == self.shown:
                return False
            self.shown = wanted
            self._render(size)
        except Exception as error:  # of a source, or of an avatar: whatever it is, it costs a picture only
            log.debug("no picture", exc_info=error)
            viewer.fail(error)
            return False
        return True

    def _render(self, size: tuple[int, int]) -> None:
        viewer = self.viewer
        self._follow_avatar()
        start = time.perf_counter()
        frame = viewer.frame()
        if isinstance(self.renderer, CpuRenderer):
            color = viewer.background
            self.renderer.background = color if isinstance(color, tuple) else None
        self.camera = viewer.camera(frame, size)
        self.picture = self.renderer.texture(frame, self.camera)
        viewer.avatar.stages.add("frame", time.perf_counter() - start)

    def _follow_avatar(self) -> None:
        """The renderer draws the viewer's avatar, which may have another deformer, or be another one."""
        avatar, drawn = self.viewer.avatar, self.renderer.avatar
        if avatar is drawn:
            return
        if avatar.bundle is drawn.bundle:
            self.renderer.avatar = self.overlays.avatar = avatar
        else:
            self.overlays = Overlays(self.window.ctx, avatar)
            self.picture = None
            self.renderer = choose_renderer(self.backend, self.window.ctx, avatar)
            self.window.set_title(f"{self.viewer.loaded.path.name} - cap4d-view")

    def _show(self, layout: Layout, is_new: bool) -> None:
        """Lays the picture and the panels out in the window."""
        window, viewer, place = self.window, self.viewer, self._place(layout)
        canvas = self._draw_canvas(place[2:], is_new) if self.picture is not None else None
        pixels = window.use()
        window.ctx.clear(*LEFT_OVER)
        if self.picture is not None:
            window.ctx.viewport = place
            self.backdrop.draw(canvas or self.picture, viewer.background, upright=True)
            window.ctx.viewport = (0, 0, *pixels)
        now, start = viewer.now, time.perf_counter()
        self._draw_panels(layout, pixels, now)
        viewer.avatar.stages.add("gui", time.perf_counter() - start)
        window.show_cursor(self.gui.cursor())
        window.ctx.gc()

    def _draw_canvas(self, size: tuple[int, int], is_new: bool) -> moderngl.Texture | None:
        """The picture with its overlays, if there are any; a recording gets what is new of it."""
        viewer, recording = self.viewer, self.taking.recorder is not None and is_new
        self.overlays.shown, self.overlays.part = set(viewer.overlays), viewer.overlay_part
        if not (viewer.overlays or recording) or min(size) < 1:
            return None
        if is_new or self.canvas.texture is None or self.canvas.texture.size != size:
            self._fill_canvas(viewer.background, size)
        if recording:
            self.taking.add(self.canvas.read())
        return self.canvas.texture

    def _fill_canvas(self, background: Background, size: tuple[int, int]) -> None:
        drawn_by = {"overlays": self.overlays, "renderer": self.renderer, "camera": self.camera}
        self.canvas.draw(self.picture, background, size, **drawn_by)

    def _take_screenshot(self) -> None:
        *_, width, height = self._place(self._layout())
        if self.picture is None or min(width, height) < 1:
            return
        background = self.taking.behind(self.viewer.background)
        self._fill_canvas(background, (width, height))
        self.taking.screenshot(self.canvas.read(), is_transparent=background is None)
        self.canvas.texture = None  # another background than on screen

    def _draw_panels(self, layout: Layout, pixels: tuple[int, int], now: float) -> None:
        try:
            with self.gui.frame(self.window.size, pixels, now - self.swapped):
                self.screen.draw(self.viewer, layout, self.overlays.legends())
        except Exception as error:  # a panel that fails costs this picture's panels
            log.warning("panels: %s", error, exc_info=error)
        self.swapped = now

    def _count(self) -> None:
        viewer = self.viewer
        viewer.playback.shown(viewer.now)
        viewer.timings.picture(viewer.avatar.stages, self.renderer.name, viewer.now)
        if not viewer.loaded.is_settled:
            viewer.settle()
            return
        if self.frames == 0:
            self._start()
        self.frames += 1
        self.late += viewer.now > viewer.playback.due()

    def _start(self) -> None:
        """Time counts from the first picture on, which loads what the others find loaded."""
        log.info("deformer: %s", self.viewer.avatar.tier)
        self.viewer.avatar.stages.clear()
        self.started = self.viewer.now
        self.viewer.playback.rewind(self.started)

    def _pause(self) -> float:
        """How long there is nothing to do, s."""
        viewer, now = self.viewer, self.viewer.now
        due = float("inf") if viewer.is_settling else viewer.playback.due() - now
        toasts = viewer.toasts.next_change(now) - now
        longest = BUSY_SECONDS if viewer.jobs.label is not None else IDLE_SECONDS
        return min(due, toasts, longest)

    def _toggle_recording(self) -> None:
        *_, width, height = self._place(self._layout())
        self.taking.toggle_recording((width, height))
        self.gui.touch()

    def _toggle_vsync(self) -> None:
        self.viewer.has_vsync = not self.viewer.has_vsync
        self.window.set_vsync(self.viewer.has_vsync)

    def _obey(self) -> None:
        """Does what the user asked of the window itself."""
        while self.viewer.asked:
            match self.viewer.asked.popleft():
                case Action.QUIT:
                    self.window.close()
                case Action.SCREENSHOT:
                    self._take_screenshot()
                case Action.RECORD:
                    self._toggle_recording()
                case Action.FULLSCREEN:
                    self.window.toggle_fullscreen()
                case Action.VSYNC:
                    self._toggle_vsync()
