"""A live source without a window: a picture every 1/fps s of the wall clock, into a file."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from cap4d.app.options import Options
from cap4d.app.play_clock import PlayClock

from cap4d.drive.live import LiveStream
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import CameraPath, live_camera_path
from cap4d.player.offline import Draw, head_centre, statistics, write_stats
from cap4d.player.sound import Sound
from cap4d.player.video import VideoWriter, check_output

log = logging.getLogger(__name__)

DEFAULT_FPS = 30.0


def record_live(
    avatar: Avatar, stream: LiveStream, options: Options, out: str, *, draw: Draw, backend: str
) -> dict[str, Any]:
    """Draws what comes, as it comes, until `options.frames` pictures, the end of standard input, or Ctrl-C.

    A machine that is too slow repeats pictures: the file keeps the wall clock's time.

    Returns:
        The statistics, with those of the source under `drive`; written too, if asked for.
    Raises:
        ArgumentError: What is asked for cannot be written, or the source could not be opened.
    """
    fps = options.fps or DEFAULT_FPS
    size = options.picture_size
    cameras = live_camera_path(options.camera, avatar.camera, head_centre(avatar), fps=fps, size=size)
    several = options.frames or 2
    check_output(Path(out), fps=fps, frames=several, size=size, sound=options.audio is not None)
    sound = None if options.audio is None else Sound.load(options.audio)
    player = _Player(avatar, stream, cameras, draw)
    player.draw(0)  # loads what the others find loaded
    avatar.stages.clear()
    log.info("listening at %s", stream.address)
    with VideoWriter(out, fps=fps, sound=sound) as writer:
        clock = PlayClock(fps, time.monotonic())
        start = time.perf_counter()
        try:
            player.run(clock, writer.write, options.frames)
        except KeyboardInterrupt:
            log.info("interrupted: the file ends here")
        seconds = time.perf_counter() - start
    drive = stream.statistics()
    counts = dict(dropped=clock.dropped, late=drive["late"])
    stats = statistics(avatar, writer.frames, seconds, size=size, backend=backend, **counts)
    stats["drive"] = drive
    if options.stats is not None:
        write_stats(options.stats, stats)
    return stats


class _Player:
    """The avatar, what drives it, and from where it is seen."""

    def __init__(self, avatar: Avatar, stream: LiveStream, cameras: CameraPath, draw: Draw) -> None:
        self.avatar, self.stream, self.cameras, self._draw = avatar, stream, cameras, draw

    def run(self, clock: PlayClock, write: Callable[[np.ndarray], None], frames: int | None) -> None:
        """Draws what is due when it is, until that is enough."""
        written = 0
        while written != frames and not self.stream.ended:
            time.sleep(max(clock.due() - time.monotonic(), 0.0))
            index = clock.index(time.monotonic())
            image = self.draw(index)
            with self.avatar.stages.time("write"):
                while written <= index and written != frames:
                    write(image)
                    written += 1
            if self.stream.error is not None:
                raise self.stream.error

    def draw(self, index: int) -> np.ndarray:
        """uint8[H, W, 3], of this moment."""
        start = time.perf_counter()
        frame = self.stream.frame(time.monotonic())
        image = self._draw(self.avatar, frame, self.cameras(index, frame))
        self.stream.shown(time.monotonic())
        self.avatar.stages.add("frame", time.perf_counter() - start)
        return np.ascontiguousarray(image[..., :3])
