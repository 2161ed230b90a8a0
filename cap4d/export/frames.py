"""An avatar's frames as files of plain Gaussians, for tools that know no rig: each is a bake of one moment.

They stand in the head's own frame, as an avatar does: the head does not move, its face does.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cap4d.atomic import replacing
from cap4d.drive.clip import Clip, Frame
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError
from cap4d.export.glb import glb_bytes
from cap4d.export.ply import ply_bytes
from cap4d.export.splat import splat_bytes
from cap4d.export.spz import spz_bytes
from cap4d.gaussians import Gaussians
from cap4d.player.avatar import Avatar, Tier
from cap4d.player.video import check_file
from cap4d.track.progress import progress

log = logging.getLogger(__name__)

FORMATS: dict[str, Callable[[Gaussians], bytes]] = {
    "ply": ply_bytes,
    "splat": splat_bytes,
    "spz": spz_bytes,
    "glb": glb_bytes,
}
RANGE = re.compile(r"(\d{1,9})?:(\d{1,9})?(?::(\d{1,9}))?")


def export_file(
    avatar: Path,
    output: Path,
    *,
    format: str,
    drive: str | None = None,
    template: Path | None = None,
    fps: float | None = None,
    frame: int | None = None,
    frames: str | None = None,
    deformer: Tier = "auto",
) -> list[Path]:
    """`cap4d export`: one frame into a file, or some into numbered files of a folder.

    Args:
        output: The file; the folder (made if need be) where there is a source without `frame`, or `frames`.
        format: A key of `FORMATS`.
        drive, template, fps: As of `open_source`.
        frame: Which one; None, and no source: the face at rest.
        frames: `all`, `FIRST:END` or `FIRST:END:STEP`, of the source.
        deformer: As of `Avatar`; nobody waits for a file, so `auto` is the most exact.
    Returns:
        What was written.
    Raises:
        ArgumentError: Before anything is written.
    """
    if frame is not None and frames is not None:
        raise ArgumentError("frames: expected frame or frames, got both")
    single = frames is None and (frame is not None or drive is None)
    if single:
        check_file(output, "output")
    else:
        _check_folder(output)
    player = Avatar.load(avatar, deformer=deformer, deformer_budget_ms=math.inf)
    clip = open_source(drive, player.bundle, template=template, fps=fps)
    if single:
        moment = neutral(player) if frame is None else _checked_frame(clip, frame)
        write_gaussians(pose(player, moment), output, format)
        log.info("%s: %d Gaussians, %.1f MB", output, len(player.bundle), output.stat().st_size / 1e6)
        return [output]
    return _export_clip(player, clip, output, format, parse_range(frames or "all", len(clip)))


def write_gaussians(gaussians: Gaussians, path: Path, format: str) -> None:
    """Writes one file, whole or not at all.

    Args:
        gaussians: In the head-fixed frame, OpenCV axes.
        format: A key of `FORMATS`.
    """
    if format not in FORMATS:
        raise ArgumentError(f"format: expected {', '.join(FORMATS)}, got {format}")
    data = FORMATS[format](gaussians)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def pose(avatar: Avatar, frame: Frame) -> Gaussians:
    """The Gaussians of a driven frame; its head pose is left aside."""
    avatar.check_rig(frame.rig_name)
    turns = {name: getattr(frame, name) for name in ("eye_rot", "neck_rot", "jaw_rot")}
    return avatar.pose(frame.expr, **turns)


def neutral(avatar: Avatar) -> Frame:
    """A face at rest."""
    zeros = np.zeros(3, np.float32)
    expr = np.zeros(avatar.bundle.n_expressions, np.float32)
    return Frame(0.0, avatar.rig_name, expr, zeros, zeros, zeros)


def parse_range(text: str, count: int) -> range:
    """`all`, `10:20`, `:100:5` of `count` frames.

    Raises:
        ArgumentError: Another text, or no frame.
    """
    match = RANGE.fullmatch(text)
    if text != "all" and not match:
        raise ArgumentError(f"frames: expected all, FIRST:END or FIRST:END:STEP, got {text}")
    first, end, step = (match and match[1]) or 0, (match and match[2]) or count, (match and match[3]) or 1
    chosen = range(int(first), min(int(end), count), max(1, int(step)))
    if not chosen or int(step) < 1:
        raise ArgumentError(f"frames: expected some of the {count} frames, got {text}")
    return chosen


def _export_clip(avatar: Avatar, clip: Clip, folder: Path, format: str, chosen: range) -> list[Path]:
    """Numbered by their place in the clip: `frame_00012.ply`."""
    folder.mkdir(exist_ok=True)
    written, size = [], 0
    for index in progress(chosen, "frames", len(chosen)):
        path = folder / f"frame_{index:05d}.{format}"
        write_gaussians(pose(avatar, clip.frame(index)), path, format)
        written.append(path)
        size += path.stat().st_size
    log.info("%s: %d files, %.1f MB, for %g frames a second", folder, len(written), size / 1e6, clip.fps)
    return written


def _checked_frame(clip: Clip, frame: int) -> Frame:
    if not 0 <= frame < len(clip):
        raise ArgumentError(f"frame: expected 0 to {len(clip) - 1}, got {frame}")
    return clip.frame(frame)


def _check_folder(output: Path) -> None:
    if not output.parent.is_dir():
        raise ArgumentError(f"output: the folder of {output} does not exist")
    if output.exists() and not output.is_dir():
        raise ArgumentError(f"output: expected a folder for the frames of a clip, {output} is a file")
