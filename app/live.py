"""Playing in a window: the clip on the wall clock, the camera on the mouse."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from cap4d.app.controls import Controls
from cap4d.app.gl_context import is_software
from cap4d.app.hud import Hud
from cap4d.app.options import Options
from cap4d.app.orbit import Orbit
from cap4d.app.play_clock import PlayClock
from cap4d.app.renderers import WHITE, CpuRenderer, GlRenderer, Overlay, Renderer
from cap4d.app.window import Window

from cap4d.camera import Camera
from cap4d.drive.clip import Clip, Frame
from cap4d.drive.source import open_source
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import CameraPath, camera_path, fitted
from cap4d.player.offline import head_centre, statistics, write_stats
from cap4d.player.video import check_file

log = logging.getLogger(__name__)

STAGES = ("rig", "deform", "bind", "sort", "splat", "encode")
READ_OUT_SECONDS = 0.5  # between changes of the numbers shown
IDLE_SECONDS = 0.25  # the longest sleep of a window that shows nothing new


def play_live(path: Path, options: Options, window: Window) -> None:
    """Plays the avatar at `path` until the window is closed, or for `options.frames` pictures.

    Raises:
        ArgumentError, DataError: The avatar or what drives it is not sound.
    """
    if options.stats is not None:
        check_file(options.stats, "stats")
    avatar = Avatar.load(path, deformer=options.deformer)
    log.info("deformer: %s", avatar.tier)
    clip = open_source(options.drive, avatar.bundle, template=options.template, fps=options.fps)
    avatar.check_rig(clip.rig_name)
    cameras = camera_path(options.camera, avatar.camera, head_centre(avatar), fps=clip.fps, size=None)
    player = LivePlayer(window, choose_renderer(options.backend, window, avatar), avatar, clip, cameras)
    try:
        player.run(options.frames)
    finally:
        player.hud.release()
    if options.stats is not None:
        write_stats(options.stats, player.statistics())


def choose_renderer(wanted: str, window: Window, avatar: Avatar) -> Renderer:
    """`auto` is OpenGL unless a software driver stands behind it, which the CPU renderer beats."""
    if wanted == "cpu" or (wanted == "auto" and is_software(window.ctx)):
        return CpuRenderer(window.ctx, avatar)
    return GlRenderer(window.ctx, avatar)


class LivePlayer:
    """One avatar and one clip in one window.

    Args:
        window: Where to draw.
        renderer: How.
        avatar: Whose stages are shown.
        clip: What plays, again and again.
        cameras: Where from, until the user takes the camera.
    """

    def __init__(
        self, window: Window, renderer: Renderer, avatar: Avatar, clip: Clip, cameras: CameraPath
    ) -> None:
        self.window, self.renderer, self.avatar = window, renderer, avatar
        self.clip, self.cameras = clip, cameras
        self.centre = head_centre(avatar)
        self.overlay = Overlay(window.ctx)
        self.hud = Hud(window.ctx)
        self.read_out = ReadOut()
        self.clock = PlayClock(clip.fps, time.perf_counter())
        self.controls = Controls(self.clock, self._orbit)
        self.shown: tuple | None = None  # what the picture on screen depends on
        self.frames = self.late = 0
        self.started = time.perf_counter()
        window.connect(self.controls)

    def run(self, frames: int | None) -> None:
        """Draws until the window closes, the user quits, or `frames` pictures were shown."""
        while not (self.window.should_close or self.controls.quit or self.frames == frames):
            self.window.poll()
            if not self._show():
                self.window.wait(min(self.clock.due() - time.perf_counter(), IDLE_SECONDS))

    def statistics(self) -> dict:
        """What `--stats` writes."""
        seconds = time.perf_counter() - self.started
        return statistics(
            self.avatar,
            self.frames,
            seconds,
            size=self.window.framebuffer_size,
            backend=self.renderer.name,
            dropped=self.clock.dropped,
            late=self.late,
        )

    def _show(self) -> bool:
        """Draws what is due; False if that is on screen already, or the window has no pixels."""
        size = self.window.framebuffer_size
        index = self.clock.index(time.perf_counter())
        wanted = (index, self.controls.orbit, self.controls.shows_hud, size)
        if wanted == self.shown or min(size) < 1:
            return False
        start = time.perf_counter()
        frame = self.clip.frame(index)
        picture = self.renderer.texture(frame, self._camera(index, frame))
        self.avatar.stages.add("frame", time.perf_counter() - start)
        self.window.use()
        self.overlay.draw(picture, WHITE, upright=True)
        if self.controls.shows_hud:
            self._draw_read_out(index)
        self.window.swap()
        self._count(wanted)
        return True

    def _count(self, wanted: tuple) -> None:
        if self.frames == 0:
            self._start()
        self.shown = wanted
        self.frames += 1
        self.late += time.perf_counter() > self.clock.due()
        self.read_out.tick(time.perf_counter())
        self.window.ctx.gc()

    def _start(self) -> None:
        """Time counts from the first picture on, which loads what the others find loaded."""
        self.avatar.stages.clear()
        self.started = time.perf_counter()
        self.clock.rewind(self.started)

    def _camera(self, index: int, frame: Frame) -> Camera:
        """The CPU draws the window's own units, however many pixels a display has to each."""
        size = self.window.size if self.renderer.name == "cpu" else self.window.framebuffer_size
        size = max(size[0], 1), max(size[1], 1)
        if self.controls.orbit is not None:
            return self.controls.orbit.camera(*size)
        return fitted(self.cameras(index, frame), size)

    def _orbit(self) -> Orbit:
        """The view of the path at this moment, for the user to take over."""
        index = self.clock.index(time.perf_counter())
        return Orbit.from_camera(self.cameras(index, self.clip.frame(index)), self.centre)

    def _draw_read_out(self, index: int) -> None:
        lines = self.read_out.lines(self.avatar, self.renderer.name, time.perf_counter())
        window, pixels = self.window.size, self.window.framebuffer_size
        scale = pixels[0] / max(window[0], 1), pixels[1] / max(window[1], 1)
        self.hud.draw([*lines, f"frame {index % len(self.clip) + 1} / {len(self.clip)}"], window, scale)


class ReadOut:
    """The numbers over the picture; they change twice a second, so that they can be read."""

    def __init__(self) -> None:
        self.times: deque[float] = deque(maxlen=120)  # of recent pictures
        self.text: list[str] = []
        self.written = -1e9

    def tick(self, now: float) -> None:
        """A picture was shown."""
        self.times.append(now)

    def fps(self) -> float:
        """Pictures per second of the last two seconds."""
        recent = [t for t in self.times if t > self.times[-1] - 2] if self.times else []
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    def lines(self, avatar: Avatar, backend: str, now: float) -> list[str]:
        """Frames per second, and the recent milliseconds of every stage."""
        if now - self.written > READ_OUT_SECONDS:
            self.written = now
            seconds = avatar.stages.seconds
            rows = [f"{name:7} {_recent_ms(seconds[name]):5.1f} ms" for name in STAGES if seconds.get(name)]
            self.text = [f"{self.fps():.0f} fps  {backend}", *rows]
        return self.text


def _recent_ms(seconds: Iterable[float]) -> float:
    return float(np.median(list(seconds)[-30:])) * 1e3
