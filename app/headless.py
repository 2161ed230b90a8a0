"""Playing without a window, into a file: every frame of a clip, or a live source while it lasts."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
from cap4d.app.loading import open_stream
from cap4d.app.options import Options
from cap4d.app.real_time import record_live
from cap4d.app.renderers import open_gl

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.drive.open_live import is_live
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar
from cap4d.player.offline import Draw, Output, draw_on_cpu, pipeline_threads, render_to

log = logging.getLogger(__name__)


def play_headless(path: Path, options: Options) -> None:
    """Renders the avatar at `path` to `options.out`, or to a video of its name in the current folder.

    Raises:
        ArgumentError, DataError: See `cap4d.player.offline.render_to`; `--pipeline` on another backend.
        GlUnavailableError: `--backend gl` without OpenGL 4.1.
    """
    threads = pipeline_threads() if options.pipeline else 0
    avatar = Avatar.load(path, deformer=options.deformer, threads=threads, deformer_budget_ms=math.inf)
    if is_live(options.drive):
        return _play_live_source(path, avatar, options)
    clip = open_source(options.drive, avatar.bundle, template=options.template, fps=options.fps)
    backend, draw = choose_backend(options.backend, avatar)
    if options.pipeline and backend != "cpu":
        raise ArgumentError(f"pipeline: expected the cpu backend, got {backend}")
    out = options.out or f"{path.stem}.mp4"
    size = options.picture_size
    output = Output(out, frames=options.frames, size=size, stats=options.stats, audio=options.audio)
    pipelined = options.pipeline
    stats = render_to(avatar, clip, options.camera, output, draw=draw, backend=backend, pipelined=pipelined)
    log.info("%s: %d frames, %.1f fps (%s)", out, stats["frames"], stats["fps"], backend)


def _play_live_source(path: Path, avatar: Avatar, options: Options) -> None:
    if options.pipeline:
        raise ArgumentError(f"pipeline: expected a file to play, got {options.drive}, which comes live")
    backend, draw = choose_backend(options.backend, avatar)
    out = options.out or f"{path.stem}.mp4"
    driving = options.driving | {"fps": None}  # --fps is the file's
    with open_stream(options.drive, avatar.bundle, **driving) as stream:
        stats = record_live(avatar, stream, options, out, draw=draw, backend=backend)
    drive = stats["drive"]
    log.info(
        "%s: %d frames, %.1f fps (%s); %d received, %d refused, latency %.0f ms (95 %%: %.0f ms)",
        *(out, stats["frames"], stats["fps"], backend, drive["received"], sum(drive["rejected"].values())),
        *(drive["latency_ms"]["median"], drive["latency_ms"]["p95"]),
    )
    if not drive["shown"]:
        log.warning("%s: no frame came that could be shown: the face is at rest", drive["source"])


def choose_backend(wanted: str, avatar: Avatar) -> tuple[str, Draw]:
    """The backend's name and its call.

    Raises:
        GlUnavailableError: See `open_gl`.
    """
    renderer = open_gl(wanted, avatar)
    if renderer is None:
        return "cpu", draw_on_cpu

    def draw_on_gpu(_: Avatar, frame: Frame, camera: Camera) -> np.ndarray:
        return renderer.draw(frame, camera)

    return "gl", draw_on_gpu
