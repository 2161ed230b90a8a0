"""Avatar + clip + camera path -> pictures, as fast as the machine goes; times per stage beside them."""

from __future__ import annotations

import json
import logging
import math
import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.atomic import replacing
from cap4d.camera import Camera
from cap4d.drive.clip import Clip, Frame
from cap4d.drive.sample import sample
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar, Tier
from cap4d.player.camera_path import CameraPath, camera_path
from cap4d.player.deformer import default_threads
from cap4d.player.sound import Sound
from cap4d.player.stages import peak_memory_mb
from cap4d.player.video import MAX_SIDE, VideoWriter, check_file, check_output

log = logging.getLogger(__name__)

WHITE = (1.0, 1.0, 1.0)
PROGRESS_SECONDS = 2.0  # between lines of progress
STATS_SCHEMA = 1

Draw = Callable[[Avatar, Frame, Camera], np.ndarray]
"""(avatar, frame, camera) -> uint8[H, W, 3 | 4], composited. A backend; times go to `avatar.stages`."""


@dataclass(frozen=True)
class Output:
    """What a render comes to.

    Args:
        path: `*.mp4`, `*.png` or `frame_%04d.png`; None draws without writing.
        frames: How many; None is the clip, once.
        fps: Of the pictures; None is the clip's own.
        size: (width, height) px; None is the camera's.
        stats: JSON file for the times, or None.
        audio: The sound of an mp4, a .wav, or None; it starts with the first picture and ends with the last.
    """

    path: str | Path | None
    frames: int | None = None
    fps: float | None = None
    size: tuple[int, int] | None = None
    stats: Path | None = None
    audio: Path | None = None


def draw_on_cpu(avatar: Avatar, frame: Frame, camera: Camera) -> np.ndarray:
    """The CPU backend, on white."""
    return avatar.draw(frame, camera, background=WHITE)


def render_clip(
    avatar: Avatar,
    clip: Clip,
    path: CameraPath,
    *,
    frames: int | None = None,
    fps: float | None = None,
    draw: Draw = draw_on_cpu,
    pipelined: bool = False,
) -> Iterator[np.ndarray]:
    """Draws a clip, frame by frame.

    Args:
        clip: Expressions of the avatar's own rig; it starts again at its end.
        path: See `camera_path`.
        frames: How many pictures; None is the clip, once.
        fps: Pictures per second; None is the clip's own rate, and another rate interpolates.
        draw: The backend.
        pipelined: Work out the next frame's face while a frame is drawn, on the CPU: see `pipelined_images`.
    Yields:
        uint8[H, W, 3] sRGB.
    Raises:
        ArgumentError: The clip is another rig's.
    """
    avatar.check_rig(clip.rig_name)
    fps = fps or clip.fps
    driven = ((i, sample(clip, i / fps)) for i in range(frame_count(clip, frames, fps)))
    if pipelined:
        images = pipelined_images(avatar, driven, path)
    else:
        images = (draw(avatar, frame, path(index, frame)) for index, frame in driven)
    start = time.perf_counter()
    for image in images:
        avatar.stages.add("frame", time.perf_counter() - start)
        yield np.ascontiguousarray(image[..., :3])
        start = time.perf_counter()


def pipelined_images(
    avatar: Avatar, driven: Iterator[tuple[int, Frame]], path: CameraPath
) -> Iterator[np.ndarray]:
    """Pictures on white, each drawn while a second thread poses the frame after it.

    More of them a second where posing and drawing leave cores idle by themselves; each comes a frame later
    than it could. Give the avatar fewer threads than there are cores, or the two get in each other's way.
    """
    with ThreadPoolExecutor(1) as worker:

        def begin() -> tuple[int, Frame, Future[np.ndarray]] | None:
            index, frame = next(driven, (0, None))
            return None if frame is None else (index, frame, worker.submit(avatar.move, frame))

        ahead = begin()
        while ahead is not None:
            index, frame, moving = ahead
            vertices = moving.result()
            ahead = begin()
            yield avatar.splat(vertices, path(index, frame), background=WHITE)


def pipeline_threads() -> int:
    """How many of the cores posing and drawing get each, when they run side by side."""
    return max(1, default_threads() // 2)


def frame_count(clip: Clip, frames: int | None, fps: float) -> int:
    """How many pictures a render has.

    Raises:
        ArgumentError: Less than one.
    """
    count = max(1, round(clip.duration * fps)) if frames is None else frames
    if count < 1:
        raise ArgumentError(f"frames: expected at least 1, got {count}")
    return count


def render_to(
    avatar: Avatar,
    clip: Clip,
    camera: str,
    output: Output,
    *,
    draw: Draw = draw_on_cpu,
    backend: str = "cpu",
    pipelined: bool = False,
) -> dict[str, Any]:
    """Draws a clip into a file and returns (and writes, if asked) the statistics.

    Args:
        camera: `static`, `orbit` or a file, see `camera_path`.
        backend: Name of `draw`, for the statistics.
        pipelined: See `render_clip`.
    Raises:
        ArgumentError, DataError: Before anything is written.
    """
    fps = output.fps or clip.fps
    total = frame_count(clip, output.frames, fps)
    path = camera_path(camera, avatar.camera, head_centre(avatar), fps=fps, size=output.size)
    _check(output, path(0, clip.frame(0)), fps=fps, total=total)
    sound = None if output.audio is None else Sound.load(output.audio)
    images = render_clip(avatar, clip, path, frames=total, fps=fps, draw=draw, pipelined=pipelined)
    first = next(images)
    avatar.stages.clear()  # the first frame loads what the others find loaded
    start = time.perf_counter()
    with VideoWriter(output.path, fps=fps, sound=sound) if output.path is not None else _Nowhere() as writer:
        for image in _with_progress(chain((first,), images), total):
            with avatar.stages.time("write"):
                writer.write(image)
    seconds = time.perf_counter() - start
    stats = statistics(avatar, total, seconds, size=(first.shape[1], first.shape[0]), backend=backend)
    if output.stats is not None:
        write_stats(output.stats, stats)
    return stats


def render_file(
    avatar: Path,
    output: str | Path,
    *,
    drive: str | None = None,
    template: Path | None = None,
    fps: float | None = None,
    camera: str = "static",
    size: str | None = None,
    frames: int | None = None,
    stats: Path | None = None,
    deformer: Tier = "auto",
    pipelined: bool = False,
    audio: Path | None = None,
) -> dict[str, Any]:
    """`cap4d render`: see `render_to`; `drive`, `template` and `fps` are `open_source`'s, `size` is `WxH`.

    Nobody waits for a file, and it should not depend on the machine: `auto` is the most exact deformer.
    """
    threads = pipeline_threads() if pipelined else 0
    player = Avatar.load(avatar, deformer=deformer, threads=threads, deformer_budget_ms=math.inf)
    clip = open_source(drive, player.bundle, template=template, fps=fps)
    pixels = None if size is None else parse_size(size)
    wanted = Output(output, frames=frames, size=pixels, stats=stats, audio=audio)
    found = render_to(player, clip, camera, wanted, pipelined=pipelined)
    log.info("%s: %d frames, %.1f fps", output, found["frames"], found["fps"])
    return found


def parse_size(text: str) -> tuple[int, int]:
    """`512x384` -> (512, 384)

    Raises:
        ArgumentError: Not two numbers of 1 to `MAX_SIDE`.
    """
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise ArgumentError(f"size: expected WIDTHxHEIGHT, 1 to {MAX_SIDE} px each, got {text}")
    return size


def head_centre(avatar: Avatar) -> np.ndarray:
    """[3] m the middle of what deforms, or of everything: what an orbit turns around."""
    points = avatar.vertices(np.zeros(avatar.bundle.n_expressions, np.float32))
    if avatar.bundle.grid.deformable.any():
        points = points[avatar.bundle.grid.deformable]
    return (points.min(0) + points.max(0)).astype(np.float64) / 2


def statistics(
    avatar: Avatar,
    frames: int,
    seconds: float,
    *,
    size: tuple[int, int],
    backend: str,
    dropped: int = 0,
    late: int = 0,
) -> dict[str, Any]:
    """What `--stats` writes; `stages` holds median, 95th and 99th percentile per stage, ms."""
    return {
        "schema": STATS_SCHEMA,
        "backend": backend,
        "deformer": avatar.tier,
        "tier_errors": {
            tier: {"rms_mm": rms, "max_mm": worst} for tier, (rms, worst) in avatar.bundle.tier_errors.items()
        },
        "gaussians": len(avatar.bundle),
        "width": size[0],
        "height": size[1],
        "frames": frames,
        "seconds": round(seconds, 3),
        "fps": round(frames / seconds, 2) if seconds > 0 else 0.0,
        "dropped": dropped,
        "late": late,
        "memory_mb": round(peak_memory_mb(), 1),
        "stages": avatar.stages.report(),
    }


def write_stats(path: Path, stats: dict[str, Any]) -> None:
    """Writes the statistics as JSON, through a temporary file.

    Raises:
        ArgumentError: No such file can be.
    """
    check_file(path, "stats")
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(stats, indent=1) + "\n")


class _Nowhere:
    """A writer that keeps nothing."""

    def __enter__(self) -> _Nowhere:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def write(self, image: np.ndarray) -> None:
        pass


def _check(output: Output, view: Camera, *, fps: float, total: int) -> None:
    """Raises ArgumentError where `total` pictures, the first seen by `view`, cannot be written so."""
    if output.stats is not None:
        check_file(output.stats, "stats")
    if output.path is not None:
        size, sounds = (view.width, view.height), output.audio is not None
        check_output(Path(output.path), fps=fps, frames=total, size=size, sound=sounds)


def _with_progress(images: Iterator[np.ndarray], total: int) -> Iterator[np.ndarray]:
    """The same pictures; says now and then how long the rest of `total` will take."""
    start = shown = time.perf_counter()
    for done, image in enumerate(images, 1):
        yield image
        if time.perf_counter() - shown > PROGRESS_SECONDS:
            shown = time.perf_counter()
            left = (shown - start) / done * (total - done)
            log.info("frame %d of %d, %.0f s left", done, total, left)
