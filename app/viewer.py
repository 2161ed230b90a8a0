"""What the window shows and the user can change: the state behind the panels, without window or OpenGL."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np
from cap4d.app.accompaniment import Accompaniment
from cap4d.app.background import WHITE, Background, Picture
from cap4d.app.controls import Controls
from cap4d.app.dropped import Use, use_of
from cap4d.app.expressions import Expression, listed
from cap4d.app.jobs import Jobs
from cap4d.app.loading import ALL, Loaded, load_avatar, open_playback, with_deformer
from cap4d.app.orbit import Orbit
from cap4d.app.overlays.overlays import Overlay, Part
from cap4d.app.overrides import Overrides
from cap4d.app.playback import SPEEDS, ClipPlayback, Playback, StreamPlayback
from cap4d.app.quality import Quality
from cap4d.app.recent import RecentFiles
from cap4d.app.shortcuts import Action
from cap4d.app.sound import SoundPlayer
from cap4d.app.timings import Timings
from cap4d.app.toasts import Toasts

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.errors import Cap4dError
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import STANDING, camera_path, fitted, with_live_head
from cap4d.player.sound import Sound

Clock = Callable[[], float]

WINDOW_ACTIONS = (Action.SCREENSHOT, Action.RECORD, Action.QUIT, Action.FULLSCREEN, Action.VSYNC)
"""What only the window can do; it takes them from `Viewer.asked`."""


class Viewer:
    """One avatar, what drives it, and what the user's hand changes.

    Args:
        loaded: The avatar.
        playback: What drives it; closed with the viewer or when another takes its place.
        fill, sender: Of live sources; see `open_playback`.
        camera: See `camera_path`.
        deformer: What the user asked for; `auto` is found once the first picture is there.
        recent: The files opened lately.
        is_welcome: Says how to go on: nothing was asked for.
        clock: s, only forward; the one of live streams.
        executor: See `Jobs`.
    """

    def __init__(
        self,
        loaded: Loaded,
        playback: Playback,
        *,
        fill: Mapping[str, bool] = ALL,
        sender: Path | None = None,
        camera: str = "static",
        deformer: str = "auto",
        recent: RecentFiles,
        is_welcome: bool = False,
        clock: Clock = time.monotonic,
        executor: Executor | None = None,
    ) -> None:
        self.loaded, self.playback, self.recent, self.clock = loaded, playback, recent, clock
        self.fill, self.sender = fill, sender
        self.camera_spec, self.wanted_deformer = camera, deformer
        self.toasts, self.timings, self.quality = Toasts(), Timings(), Quality()
        self.jobs = Jobs(self.fail, executor)
        self.controls = Controls(self._orbit)
        self.shows_panels = self.shows_sidebar = True
        self.shows_help = False
        self.dialog: Action | None = None  # OPEN or DRIVE, while its window is open
        self.is_welcome = is_welcome
        self.background: Background = WHITE
        self.accompaniment: Accompaniment | None = None
        self.overlays: frozenset[Overlay] = frozenset()
        self.overlay_part = Part.ALL
        self.display_hz = 60.0
        self.has_vsync = True  # pictures wait for the display
        self.recording_since: float | None = None
        self.asked: deque[Action] = deque()
        self.has_news = False  # a message that was not drawn yet
        self.is_settling = False  # nothing should be drawn: the deformers are being measured
        self.random = np.random.default_rng()
        self._take_avatar(loaded)

    @property
    def avatar(self) -> Avatar:
        return self.loaded.avatar

    @property
    def now(self) -> float:
        return self.clock()

    def close(self) -> None:
        """Ends what runs in the background."""
        self.jobs.close()
        self.playback.close()
        self.set_sound(None)

    # What is shown

    def number(self) -> Hashable:
        """Changes when the next picture would be another one; size and renderer apart."""
        playing = self.playback.number(self.now)
        look = self.background, self.overlays, self.overlay_part
        return self.avatar, self.playback, playing, self.overrides.version, self.controls.orbit, look

    def frame(self) -> Frame:
        """What the avatar does at the moment that `number` spoke of, the user's hand included."""
        return self.overrides.apply(self.playback.frame())

    def camera(self, frame: Frame, size: tuple[int, int]) -> Camera:
        """Where from, for a picture of `size`."""
        size = max(size[0], 1), max(size[1], 1)
        orbit = self.controls.orbit
        camera = orbit.camera(*size) if orbit is not None else fitted(self._path_camera(frame), size)
        camera = replace(camera, viewmat=self.overrides.turned(camera.viewmat, self.loaded.centre))
        stands = self.playback.is_live and self.camera_spec in STANDING
        return with_live_head(camera, frame) if stands else camera

    def settle(self) -> None:
        """Finds the deformer that suits this machine, if that is still to be done."""
        if not self.loaded.is_settled:
            self.loaded = replace(self.loaded, is_settled=True)  # once: a network that fails is said and left
            self.is_settling = True
            self._change_deformer(self.wanted_deformer, "Choosing a deformer")

    def poll(self) -> bool:
        """Takes over what the background has finished; whether anything has."""
        finished = self.jobs.poll()
        if finished and self.jobs.label is None:
            self.is_settling = False
        self._hear()
        return finished

    # What the user does

    def act(self, action: Action) -> None:
        """Does what a key or a menu item asks for."""
        if action in WINDOW_ACTIONS:
            self.asked.append(action)
        elif isinstance(self.playback, ClipPlayback) and action in CLIP_ACTIONS:
            CLIP_ACTIONS[action](self, self.playback)
        elif action in ACTIONS:
            ACTIONS[action](self)

    def open(self, path: Path) -> None:
        """Opens a file for what its name says it is; a recent one that is gone is forgotten."""
        if path in self.recent.files and not os.path.exists(path):
            self.recent.forget(path)
        try:
            use = use_of(path)
        except Cap4dError as error:
            self.fail(error)
            return
        match use:
            case Use.AVATAR:
                self.open_avatar(path)
            case Use.DRIVE:
                self.drive(str(path))
            case Use.SOUND:
                self.jobs.start(f"Opening {path.name}", lambda: Sound.load(path), self.set_sound)
            case Use.BACKGROUND:
                self.jobs.start(f"Opening {path.name}", lambda: Picture.load(path), self._set_background)

    def open_avatar(self, path: Path) -> None:
        """Shows another avatar, in the background until it is loaded."""
        deformer = self.wanted_deformer

        def load() -> Loaded:
            try:
                return load_avatar(path, deformer)
            except Cap4dError:
                if deformer == "auto":
                    raise
                return load_avatar(path)  # one without the deformer that the last one was shown with

        self.jobs.start(f"Opening {path.name}", load, self._show_avatar)

    def drive(self, spec: str | None) -> None:
        """Lets another source drive the avatar: a file, an address, or None for its own idle clip."""
        name = "the idle clip" if spec is None else spec

        def open_it() -> Playback:
            if self.playback.is_live:
                self.playback.close()  # the next one may listen to the same address
            return open_playback(spec, self.loaded.bundle, sender=self.sender, fill=self.fill)

        self.jobs.start(f"Opening {name}", open_it, lambda playback: self._play(playback, spec))

    def choose_deformer(self, tier: str) -> None:
        """Changes how the avatar's network is evaluated: one of its tiers, or `auto`."""
        self.wanted_deformer = tier
        self.is_settling = tier == "auto"
        self._change_deformer(tier, f"Changing to {tier}")

    def set_sound(self, sound: Sound | None) -> None:
        """Lets a sound play beside the clip, whose clock it then rules; None: silence."""
        if self.accompaniment is not None:
            self.accompaniment.close()
        self.accompaniment = None if sound is None else Accompaniment(SoundPlayer.open(sound))
        if sound is not None and isinstance(self.playback, ClipPlayback):
            self.playback.rewind(self.now)

    def fail(self, error: BaseException) -> None:
        """Shows an error; nothing ends."""
        self.toasts.fail(error, self.now)
        self.has_news = True

    def say(self, text: str) -> None:
        """Shows a message."""
        self.toasts.say(text, self.now)
        self.has_news = True

    def _change_deformer(self, tier: str, label: str) -> None:
        loaded = self.loaded
        self.jobs.start(label, lambda: with_deformer(loaded, tier), self._swap)

    def _swap(self, loaded: Loaded) -> None:
        """The avatar with another deformer takes its place, unless it was replaced meanwhile."""
        if loaded.bundle is self.loaded.bundle:
            loaded.avatar.stages = self.avatar.stages
            self.loaded = loaded

    def _show_avatar(self, loaded: Loaded) -> None:
        playback = open_playback(None, loaded.bundle)
        self._replace_playback(playback)
        self._take_avatar(loaded)
        self.recent.add(loaded.path)
        self.is_welcome = False
        self.say(f"{loaded.path.name}: {len(loaded.bundle):,} Gaussians, {loaded.avatar.rig_name}")

    def _take_avatar(self, loaded: Loaded) -> None:
        bundle = loaded.bundle
        path = camera_path(self.camera_spec, bundle.camera, loaded.centre, fps=bundle.idle.fps, size=None)
        self.loaded, self._path, self._path_fps = loaded, path, bundle.idle.fps
        self.expressions: list[Expression] = listed(bundle)
        self.overrides = Overrides(bundle.expression_range)
        self.controls.reset()

    def _play(self, playback: Playback, spec: str | None) -> None:
        try:
            self.avatar.check_rig(playback.rig_name)
        except Cap4dError:
            playback.close()  # a live one holds a thread and a port
            raise
        self._replace_playback(playback)
        if spec is not None and not playback.is_live:
            self.recent.add(Path(spec))
        self.say(f"Playing {playback.name}")

    def _replace_playback(self, playback: Playback) -> None:
        self.playback.close()
        self.playback = playback

    def _set_background(self, picture: Picture) -> None:
        self.background = picture

    def _hear(self) -> None:
        """Keeps sound and pictures together, and hears whether a source has given up."""
        playback = self.playback
        if self.accompaniment is not None:
            self.accompaniment.follow(playback, self.now)
        if isinstance(playback, StreamPlayback) and self.jobs.label is None:
            if playback.error is not None:
                self.fail(playback.error)
            if playback.error is not None or playback.is_closed:
                self.drive(None)

    def _path_camera(self, frame: Frame) -> Camera:
        return self._path(round(frame.t * self._path_fps), frame)

    def _orbit(self) -> Orbit:
        """The view of the path at this moment, for the user to take over."""
        self.playback.number(self.now)
        return Orbit.from_camera(self._path_camera(self.playback.frame()), self.loaded.centre)


def _toggle(name: str) -> Callable[[Viewer], None]:
    return lambda viewer: setattr(viewer, name, not getattr(viewer, name))


def _close(viewer: Viewer) -> None:
    if viewer.shows_help or viewer.dialog is not None:
        viewer.shows_help, viewer.dialog = False, None
    else:
        viewer.asked.append(Action.QUIT)


def _next_deformer(viewer: Viewer) -> None:
    tiers = viewer.loaded.tiers
    viewer.choose_deformer(tiers[(tiers.index(viewer.avatar.tier) + 1) % len(tiers)])


def _ask(action: Action) -> Callable[[Viewer], None]:
    return lambda viewer: setattr(viewer, "dialog", action)


def _change_speed(steps: int) -> Callable[[Viewer, ClipPlayback], None]:
    def change(viewer: Viewer, playback: ClipPlayback) -> None:
        nearest = int(np.argmin([abs(speed - playback.speed) for speed in SPEEDS]))
        playback.set_speed(SPEEDS[min(max(nearest + steps, 0), len(SPEEDS) - 1)], viewer.now)

    return change


ACTIONS: dict[Action, Callable[[Viewer], None]] = {
    Action.OPEN: _ask(Action.OPEN),
    Action.DRIVE: _ask(Action.DRIVE),
    Action.IDLE: lambda viewer: viewer.drive(None),
    Action.CLOSE: _close,
    Action.RESET_VIEW: lambda viewer: viewer.controls.reset(),
    Action.RESET_FACE: lambda viewer: viewer.overrides.reset(),
    Action.NEUTRAL_FACE: lambda viewer: viewer.overrides.neutral(),
    Action.RANDOM_FACE: lambda viewer: viewer.overrides.randomize(viewer.random),
    Action.NEXT_DEFORMER: _next_deformer,
    Action.PANELS: _toggle("shows_panels"),
    Action.SIDEBAR: _toggle("shows_sidebar"),
    Action.HELP: _toggle("shows_help"),
}
CLIP_ACTIONS: dict[Action, Callable[[Viewer, ClipPlayback], None]] = {
    Action.PLAY: lambda viewer, playback: playback.toggle(viewer.now),
    Action.NEXT: lambda viewer, playback: playback.step(1, viewer.now),
    Action.PREVIOUS: lambda viewer, playback: playback.step(-1, viewer.now),
    Action.REWIND: lambda viewer, playback: playback.rewind(viewer.now),
    Action.LOOP: lambda viewer, playback: playback.set_loops(not playback.loops, viewer.now),
    Action.FASTER: _change_speed(1),
    Action.SLOWER: _change_speed(-1),
    Action.SMOOTH: lambda viewer, playback: playback.set_smooth(
        None if playback.is_smooth else viewer.display_hz, viewer.now
    ),
}
"""What can be done to a clip, and not to a live stream."""
