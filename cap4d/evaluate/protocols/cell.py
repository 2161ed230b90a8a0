"""One cell of a protocol's table: an avatar fitted one way to some images, and how good it is.

A cell is known by all that shapes it, so that a finished one is never made again and a changed one always is.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cap4d import __version__
from cap4d.atomic import replacing
from cap4d.avatar.presets import Preset
from cap4d.capture.capture import Capture
from cap4d.errors import DataError

DIGITS = 10  # of a digest, in file names
Views = Sequence[tuple[str, int]]


@dataclass(frozen=True)
class Cell:
    """What is fitted and what it is judged on.

    Args:
        identity: The person, as the tables call them.
        capture: Their images.
        generated: Further captures, made from the references; none where a fit has its references alone.
        references: (camera, frame) that are trained on.
        hold_out: Cameras that are not.
        ablate: What is left out of the fit (see `fit`), or None.
        preset, seed: Of the fit.
        views: (camera, frame) that are looked at.
        size: Pixels of the larger side that they are looked at with.
        lpips_weights: For fits with an LPIPS term (see `fit`).
    """

    identity: str
    capture: Path
    generated: tuple[Path, ...]
    references: tuple[tuple[str, int], ...]
    hold_out: tuple[str, ...]
    ablate: str | None
    preset: Preset
    seed: int
    views: tuple[tuple[str, int], ...]
    size: int
    lpips_weights: Path | None = None

    @property
    def method(self) -> str:
        """What is left out, or `none`."""
        return self.ablate or "none"

    @property
    def name(self) -> str:
        return f"{self.identity}-{len(self.references)}-{self.method}"


@dataclass(frozen=True, eq=False)
class Judged:
    """What was measured on K views, whatever the protocol.

    Args:
        folder: Where the pictures are.
        values: Per metric, float64[K]; NaN where a view could not be measured.
        missing: Per metric that was not measured, what it needs.
    """

    folder: Path
    values: dict[str, np.ndarray]
    missing: dict[str, str]

    def mean(self, metric: str) -> float | None:
        """Over the views where it could be measured; None where it could be in none."""
        values = self.values.get(metric, np.zeros(0))
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) else None

    def picture(self, view: tuple[str, int]) -> Path:
        return self.folder / "pictures" / view[0] / f"{view[1]:05d}.png"


@dataclass(frozen=True, eq=False)
class Result(Judged):
    """A cell that is done; `fit` are the numbers of its fit (`.fit.json`)."""

    cell: Cell
    fit: dict[str, Any]


Judge = Callable[[Path, Path, Views, int, Path], tuple[dict[str, Sequence[float]], dict[str, str]]]
"""(avatar, capture, views, size, folder for pictures) -> each metric's values, and what others need."""


def run_cell(cell: Cell, rig: Path, folder: Path, judge: Judge, judged_by: str) -> Result:
    """Fits and judges a cell, or finds in `folder` that this was done.

    Args:
        folder: All cells' folder.
        judged_by: Changes when `judge` would answer otherwise.
    """
    own = folder / f"{cell.name}-{fit_digest(cell, rig)}"
    avatar = own / "avatar.cap4d"
    verdict = own / f"evaluation-{judge_digest(cell, judged_by)}.json"
    numbers = avatar.with_suffix(".fit.json")
    if not numbers.exists():
        own.mkdir(parents=True, exist_ok=True)
        fit_cell(cell, rig, avatar)
    if not verdict.exists():
        shutil.rmtree(own / "pictures", ignore_errors=True)
        values, missing = judge(avatar, cell.capture, cell.views, cell.size, own / "pictures")
        write_verdict(verdict, cell.name, cell.views, values, missing)
    values, missing = read_verdict(verdict, len(cell.views))
    return Result(own, values, missing, cell, _read(numbers))


def fit_cell(cell: Cell, rig: Path, avatar: Path) -> None:
    """Fits the avatar; goes on where an interrupted fit of the same cell stopped.

    Without the cheaper deformers: an avatar is judged by its exact one.
    """
    from cap4d.avatar.fit import fit
    from cap4d.rig.store import load_rig

    fit(
        [cell.capture, *cell.generated],
        load_rig(rig),
        avatar,
        preset=cell.preset,
        resume=True,
        ablate=cell.ablate,
        seed=cell.seed,
        lpips_weights=cell.lpips_weights,
        references=cell.references,
        hold_out=cell.hold_out,
        tiers=False,
    )


def fit_digest(cell: Cell, rig: Path) -> str:
    """Changes with whatever changes the avatar: images, tracking, rig, settings, this package's version."""
    shaped = cell.ablate, cell.seed, cell.references, cell.hold_out, str(cell.lpips_weights)
    parts = [__version__, repr(cell.preset), *shaped]
    digest = hashlib.sha256(repr(parts).encode())
    add_files(digest, [rig, cell.capture / "fit.npz"])
    add_files(digest, files_of(cell.capture, cell.references))
    for capture in cell.generated:
        found = Capture.load(capture)
        add_files(digest, [capture / "fit.npz"])
        # Hundreds of images: their names and sizes have to do.
        digest.update(repr([(v.camera, v.frame, v.image.stat().st_size) for v in found.views]).encode())
    return digest.hexdigest()[:DIGITS]


def judge_digest(cell: Cell, judged_by: str) -> str:
    """Changes with whatever changes the verdict on an avatar."""
    digest = hashlib.sha256(repr([__version__, cell.views, cell.size, judged_by]).encode())
    add_files(digest, [cell.capture / "fit.npz", *files_of(cell.capture, cell.views)])
    return digest.hexdigest()[:DIGITS]


def write_verdict(
    path: Path, name: str, views: Views, values: dict[str, Sequence[float]], missing: dict[str, str]
) -> None:
    """Numbers that are not finite (a face that was not found) are written as null."""
    plain = {n: [float(x) if np.isfinite(x) else None for x in v] for n, v in values.items()}
    document = {
        "cell": name,
        "views": [list(v) for v in views],
        "values": plain,
        "missing": missing,
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def read_verdict(path: Path, views: int) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """
    Raises:
        DataError: It is not what was written for so many views.
    """
    document = _read(path)
    try:
        values = {n: np.array(v, np.float64) for n, v in document["values"].items()}
        missing = {str(n): str(needs) for n, needs in document["missing"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(path, "values", expected="a number or null per view", found=error) from error
    if any(v.shape != (views,) for v in values.values()):
        raise DataError(path, "values", expected=f"{views} of each metric", found="another number")
    return values, missing


def files_of(capture: Path, pairs: Views) -> list[Path]:
    """Images and mattes of views."""
    by_name = {(v.camera, v.frame): v for v in Capture.load(capture).views}
    views = [by_name[tuple(pair)] for pair in pairs]
    return [file for v in views for file in (v.image, v.matte) if file is not None]


def add_files(digest, files: Sequence[Path]) -> None:
    """Feeds what is in the files to a hash."""
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(path, "file", expected="JSON", found=error) from error
    if not isinstance(document, dict):
        raise DataError(path, "file", expected="an object", found=type(document).__name__)
    return document
