"""What `--drive` names, opened: every source becomes a Clip in the avatar's own expression space."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from cap4d.bundle.bundle import Bundle
from cap4d.drive.clip import Clip
from cap4d.drive.fit import read_fit
from cap4d.drive.livelink_csv import read_livelink_csv
from cap4d.drive.retarget import Retargeter
from cap4d.drive.vertices import VERTEX_FPS, expected_vertices, read_template, read_vertices
from cap4d.errors import ArgumentError

log = logging.getLogger(__name__)

SOURCES = "a fit.npz, vertices in an .npy, or a Live Link Face recording, .csv"


def open_source(
    spec: str | None, bundle: Bundle, *, template: Path | None = None, fps: float | None = None
) -> Clip:
    """Opens a source of expressions for an avatar.

    Args:
        spec: None, the avatar's idle clip; `*.npz`, a FlowFace sequence (facts 41, 46); `*.npy`, vertices as
            CodeTalker and VOCA write them; `*.csv`, a recording of Live Link Face.
        bundle: The avatar.
        template: Neutral vertices of an `.npy`: `.npy`, `.npz` with key `template`, or `.obj`; without it the
            first frame is taken for neutral.
        fps: Frames per second of the source, whatever it says itself.
    Raises:
        ArgumentError: No such kind of source, or a template for one that takes none.
        DataError: The file is not sound, or holds the expressions or the vertices of another rig.
    """
    if fps is not None and not 0 < fps <= 1000:
        raise ArgumentError(f"fps: expected a number in (0, 1000], got {fps}")
    if template is not None and (spec is None or Path(spec).suffix != ".npy"):
        found = "the idle clip" if spec is None else spec
        raise ArgumentError(f"template: goes with vertices in an .npy only, got {found}")
    if spec is None:
        return bundle.idle if fps is None else replace(bundle.idle, fps=fps)
    path = Path(spec)
    if path.suffix == ".npz":
        return read_fit(path, bundle, fps=fps)
    if path.suffix == ".csv":
        return read_livelink_csv(path, bundle, fps=fps)
    if path.suffix == ".npy":
        return _vertex_clip(path, bundle, template, fps)
    raise ArgumentError(f"drive: expected {SOURCES}, got {spec}")


def _vertex_clip(path: Path, bundle: Bundle, template: Path | None, fps: float | None) -> Clip:
    count = expected_vertices(bundle)
    vertices = read_vertices(path, count)
    if template is None:
        log.warning("%s: no template given: its first frame is taken for the neutral face", path)
        neutral = vertices[0]
    else:
        neutral = read_template(template, count)
    found = Retargeter(bundle, count)(vertices, neutral)
    log.info(
        "%s: %d frames; %.3f mm of motion left over (root mean square; worst frame %.3f mm)",
        *(path, len(vertices), float((found.residual_mm**2).mean() ** 0.5), float(found.residual_mm.max())),
    )
    return found.clip(fps or VERTEX_FPS)
