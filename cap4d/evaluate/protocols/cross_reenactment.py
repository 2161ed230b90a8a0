"""Cross-reenactment: avatars driven by another person's performance.

There is no ground truth: nobody knows how the avatar's person would look. The paper asks ArcFace for the
identity and 24 people for the rest (fact 74). Measured here, without asking people: whether the picture is
still the avatar's person (CSIM), and whether face, gaze, lids and head do what the driver's do (the same
estimator on both pictures: AED, APD, AED-mp, APD-mp, gaze, blink). What compares pixels or places with the
driver's picture (PSNR, SSIM, LPIPS, JOD, AKD) would reward looking like the driver, and is left out.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cap4d import __version__
from cap4d.atomic import replacing
from cap4d.avatar.references import choose_held_out
from cap4d.capture.capture import Capture
from cap4d.capture.image import read_image
from cap4d.drive.clip import Clip
from cap4d.errors import ArgumentError
from cap4d.evaluate.evaluate import evaluate
from cap4d.evaluate.faces import FaceFinder
from cap4d.evaluate.metrics.metric import NotMeasured
from cap4d.evaluate.metrics.registry import metrics_available
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair
from cap4d.evaluate.protocols.cell import DIGITS, Judged, add_files, files_of, read_verdict, write_verdict
from cap4d.evaluate.protocols.cells import Failure, check_whole, run_cells
from cap4d.evaluate.protocols.layout import table
from cap4d.evaluate.protocols.page import Strip, draw_page, write_truth
from cap4d.player.avatar import Avatar

TRANSFER = ("AED", "APD", "AED-mp", "APD-mp", "gaze", "blink")
"""Metrics of what a face does, whoever's it is."""
IDENTITY = "CSIM"
SHOWN = 4  # frames of a driver on the page
DRIVER = "driver"
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Cross:
    """How it is measured.

    Args:
        frames: So many of each driver, evenly.
        size: Pixels of the pictures' larger side.
        weights: Networks of the user.
    """

    frames: int = 20
    size: int = 256
    weights: Weights = field(default_factory=Weights)


@dataclass(frozen=True, eq=False)
class Driven(Judged):
    """An avatar driven by somebody."""

    avatar: str
    driver: str
    views: tuple[tuple[str, int], ...]


def cross_reenactment(
    avatars: Sequence[Path], drivers: Sequence[Path], output: Path, cross: Cross
) -> list[Driven]:
    """Drives every avatar by every driver; what an earlier call for the same folder finished is kept.

    Args:
        avatars: `.cap4d` files.
        drivers: Captures of other people, of the avatars' rig.
        output: Folder for report.json, table.md, page.html, page.png and the cells; made if need be.
    Raises:
        ArgumentError: Names that cannot be told apart, or none; a file of the weights that is not there.
        DataError: A cell failed: the others are there; a file of the weights is no such network.
    """
    metrics_available(cross.weights, only=(IDENTITY, "AED", "APD"))
    names = _names("avatars", [a.stem for a in avatars], [a.resolve().parent.name for a in avatars])
    people = _names("drivers", [d.resolve().name for d in drivers])
    jobs = [
        (f"{name} driven by {person}", partial(drive, avatar, driver, output, cross, names=(name, person)))
        for name, avatar in zip(names, avatars, strict=True)
        for person, driver in zip(people, drivers, strict=True)
    ]
    output.mkdir(parents=True, exist_ok=True)
    results, failures = run_cells(jobs, after=partial(_write, output, cross))
    if results:
        _draw(output, results, dict(zip(people, drivers, strict=True)), cross.size)
    check_whole(output / "report.json", len(jobs), failures)
    return results


def drive(avatar: Path, driver: Path, output: Path, cross: Cross, *, names: tuple[str, str]) -> Driven:
    """One avatar driven by one person: by the most frontal camera's frames, before that camera."""
    capture = Capture.load(driver)
    views = driven_views(capture, cross.frames)
    digest = hashlib.sha256(repr([__version__, views, cross]).encode())
    add_files(digest, [avatar, driver / "fit.npz", *files_of(driver, views)])
    folder = output / "cells" / f"{names[0]}-{names[1]}-{digest.hexdigest()[:DIGITS]}"
    verdict = folder / "evaluation.json"
    if not verdict.exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        values, missing = measure(avatar, driver, views, cross, folder / "pictures")
        write_verdict(verdict, " by ".join(names), views, values, missing)
    values, missing = read_verdict(verdict, len(views))
    return Driven(folder, values, missing, *names, views)


def driven_views(capture: Capture, frames: int) -> tuple[tuple[str, int], ...]:
    """`frames` of the most frontal camera, evenly."""
    if frames < 1:
        raise ArgumentError(f"frames: expected at least 1, got {frames}")
    camera = next(iter(capture.cameras)) if len(capture.cameras) == 1 else choose_held_out(capture, 1)[0]
    own = sorted(v.frame for v in capture.views if v.camera == camera)
    picked = np.unique(np.linspace(0, len(own) - 1, min(frames, len(own))).round().astype(int))
    return tuple((camera, own[i]) for i in picked)


def measure(
    avatar: Path, driver: Path, views: Sequence[tuple[str, int]], cross: Cross, pictures: Path
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """What the face does, and whose it is; pictures are left in their folder."""
    found = evaluate(
        avatar,
        driver,
        views=views,
        weights=cross.weights,
        only=TRANSFER,
        size=cross.size,
        pictures=pictures,
    )
    if list(found.views) != [tuple(v) for v in views]:
        raise AssertionError("evaluate answered for other views than it was asked for")
    values = {name: found.values(name) for name in TRANSFER if name not in found.missing}
    missing = {name: absent.needs for name, absent in found.missing.items()}
    metric = metrics_available(cross.weights, only=(IDENTITY,))[0]
    if isinstance(metric, NotMeasured):
        return values, missing | {IDENTITY: metric.needs}
    files = [pictures / camera / f"{frame:05d}.png" for camera, frame in views]
    return values | {IDENTITY: identity(avatar, files, metric)}, missing


def identity(avatar: Path, files: Sequence[Path], metric: Any) -> np.ndarray:
    """float64[K] CSIM of pictures with the avatar's own face at rest, before its own camera.

    That picture stands in for a photo of the person, which a bundle does not hold: an avatar that does not
    look like its person is not found out by this.
    """
    resting = portrait(avatar)
    with FaceFinder() as finder:
        pairs = (Pair(_fitted(read_image(file)[..., :3], resting), resting, finder=finder) for file in files)
        values = [metric.measure(pair) for pair in pairs]
    return np.array([np.nan if v is None else v for v in values])


def portrait(avatar: Path) -> np.ndarray:
    """float32[H, W, 3] the avatar's neutral face before its own camera, on white."""
    player = Avatar.load(avatar)
    n, zeros = player.bundle.n_expressions, np.zeros((1, 3), np.float32)
    clip = Clip(
        player.rig_name, 30.0, np.zeros((1, n), np.float32), eye_rot=zeros, neck_rot=zeros, jaw_rot=zeros
    )
    return player.draw(clip.frame(0), player.camera, background=WHITE)[..., :3].astype(np.float32) / 255


def _fitted(image: np.ndarray, like: np.ndarray) -> np.ndarray:
    """The image on white, of the other's size: a face's vector does not mind the empty rim."""
    from cap4d.avatar.views import shrink

    scale = min(like.shape[0] / image.shape[0], like.shape[1] / image.shape[1], 1.0)
    height, width = (round(side * scale) for side in image.shape[:2])
    small = shrink(image, width, height).numpy()
    canvas = np.ones_like(like)
    canvas[:height, :width] = small
    return canvas


def _write(output: Path, cross: Cross, results: Sequence[Driven], failures: Sequence[Failure]) -> None:
    cells = [
        {
            "avatar": r.avatar,
            "driver": r.driver,
            "views": [list(v) for v in r.views],
            "mean": {m: r.mean(m) for m in r.values},
            "values": {m: [float(x) if np.isfinite(x) else None for x in v] for m, v in r.values.items()},
        }
        for r in results
    ]
    document = {
        "protocol": "cross-reenactment",
        "size": cross.size,
        "cells": cells,
        "failed": [{"cell": f.name, "reason": f.reason} for f in failures],
        "not_measured": {n: needs for r in results for n, needs in r.missing.items()},
    }
    with replacing(output / "report.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with replacing(output / "table.md") as temporary:
        temporary.write_text("\n".join(markdown(results, failures)) + "\n", encoding="utf-8")


def markdown(results: Sequence[Driven], failures: Sequence[Failure]) -> list[str]:
    """The table, and in words what its numbers are."""
    metrics = [m for m in (IDENTITY, *TRANSFER) if any(r.mean(m) is not None for r in results)]
    lines = ["# Cross-reenactment", ""]
    lines += [
        "No ground truth. The same estimator looks at the pictures of avatar and driver; an avatar that",
        "does exactly what the driver does is still apart by what two faces make of one estimator.",
        f"{IDENTITY}: against the avatar's own face at rest, not against a photo of its person.",
        "",
    ]
    rows = [([r.avatar, r.driver], {m: r.mean(m) for m in metrics}, len(r.views)) for r in results]
    lines += table(["avatar", "driven by"], metrics, rows, "frames")
    lines += [f"- failed: {f.name}: {f.reason}" for f in failures]
    absent = {name: needs for r in results for name, needs in r.missing.items()}
    return lines + [f"- {name}: not measured: needs {needs}" for name, needs in absent.items()]


def _draw(output: Path, results: Sequence[Driven], drivers: dict[str, Path], size: int) -> None:
    avatars = list(dict.fromkeys(r.avatar for r in results))
    strips = []
    for name in dict.fromkeys(r.driver for r in results):
        own = [r for r in results if r.driver == name]
        capture = Capture.load(drivers[name])
        picked = np.unique(np.linspace(0, len(own[0].views) - 1, SHOWN).round().astype(int))
        for view in (own[0].views[i] for i in picked):
            file = output / "truth" / name / f"{view[0]}_{view[1]:05d}.png"
            write_truth(capture, view, size, file)
            pictures = {r.avatar: r.picture(view) for r in own}
            strips.append(Strip(f"{name}, frame {view[1]}", {DRIVER: file, **pictures}))
    draw_page(output, [DRIVER, *avatars], strips)


def _names(kind: str, *choices: list[str]) -> list[str]:
    """The first choice of names that tells all apart."""
    for names in choices:
        if names and len(set(names)) == len(names):
            return names
    raise ArgumentError(f"{kind}: expected different names, got {', '.join(choices[0]) or 'none'}")
