"""How near an avatar comes to a capture: driven by the capture's own parameters, seen by its own cameras."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.camera import Camera
from cap4d.capture.capture import Capture, View
from cap4d.capture.image import write_image
from cap4d.errors import ArgumentError, DataError
from cap4d.evaluate.evaluation import Evaluation
from cap4d.evaluate.faces import AvertedFinder, FaceFinder, faces_camera
from cap4d.evaluate.metrics.jod import JustObjectionableDifference
from cap4d.evaluate.metrics.metric import Metric, NotMeasured
from cap4d.evaluate.metrics.registry import metrics_available
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair
from cap4d.evaluate.sheet import Sheet
from cap4d.evaluate.views import chosen_views, runs, sized_camera
from cap4d.player.avatar import Avatar, Tier
from cap4d.rig.flame import RELEASED_RIG
from cap4d.track.progress import progress

WHITE = (1.0, 1.0, 1.0)
SIZES = 16, 16384  # px of the larger side
NEED_FACES = ("CSIM", "AED", "APD", "AKD", "gaze", "blink", "AKD-fan", "AED-mp", "APD-mp")
PACKAGES = ("cap4d", "numpy", "onnxruntime", "torch", "mediapipe", "pyfvvdp")


def evaluate(
    avatar: Path,
    capture: Path,
    *,
    views: Sequence[tuple[str, int]] | None = None,
    weights: Weights | None = None,
    only: Sequence[str] | None = None,
    size: int | None = None,
    deformer: Tier = "auto",
    pictures: Path | None = None,
    finder: FaceFinder | None = None,
) -> Evaluation:
    """Measures an avatar on views of a capture, one after the other: memory does not grow with their number.

    Expressions, eyes, neck, jaw and head pose are the capture's, without corrections that a fit may have
    learned. The person need not be the avatar's own: the identity of the capture has no say. Faces are looked
    for in views from at most 75 degrees aside.

    Args:
        avatar: `.cap4d` file.
        capture: Folder; its truth is on white through its mattes or alpha, where it has any.
        views: (camera, frame); None: all the capture has.
        weights: Networks of the user for metrics that need them.
        only: Names of metrics; None: all.
        size: Of the larger side, px: truth is averaged down to it, never up; None: as the capture is.
        deformer: As of `Avatar`; `auto` is the most exact.
        pictures: Folder for what the avatar looks like, `<camera>/<frame:05d>.png`, and some of the views
            side by side with the truth, `sheet.png`; made if need be.
        finder: One that is open, to serve several evaluations; None: one of its own.
    Raises:
        ArgumentError: An unknown view or metric, an impossible size, or a missing file of `weights`.
        DataError: A file is not sound, or the capture is of another rig.
    """
    started = time.monotonic()
    if size is not None and not SIZES[0] <= size <= SIZES[1]:
        raise ArgumentError(f"size: expected {SIZES[0]} to {SIZES[1]} px, got {size}")
    player = Avatar.load(avatar, deformer=deformer, deformer_budget_ms=math.inf)
    person = Capture.load(capture)
    check_rig(person, player)
    scene = Scene(player, person, chosen_views(person, views), size, pictures)
    found = metrics_available(weights or Weights(), bundle=player.bundle, only=only)
    metrics = {m.name: m for m in found if not isinstance(m, NotMeasured)}
    with FaceFinder() if finder is None else nullcontext(finder) as open_finder:
        numbers, faces = measure(scene, metrics, open_finder)
    facts = _facts(avatar, capture, scene) | {"seconds": round(time.monotonic() - started, 1)}
    return Evaluation(
        views=tuple((view.camera, view.frame) for view in scene.views),
        metrics=metrics,
        numbers=numbers,
        missing={m.name: m for m in found if isinstance(m, NotMeasured)},
        faces=faces if any(name in NEED_FACES for name in metrics) else None,
        facts=facts,
    )


@dataclass(frozen=True, eq=False)
class Scene:
    """An avatar before the cameras of a capture."""

    avatar: Avatar
    capture: Capture
    views: Sequence[View]
    size: int | None
    pictures: Path | None

    def camera(self, view: View) -> Camera:
        """In the head-fixed world, at the size that is asked for."""
        return sized_camera(self.capture.head_camera(view), self.size)

    def pair(self, view: View, finder: FaceFinder) -> Pair:
        """The avatar's picture (of 8 bits) and the truth of a view."""
        camera = self.camera(view)
        picture = self.avatar.draw(self.capture.clip().frame(view.frame), camera, background=WHITE)[..., :3]
        if self.pictures is not None:
            write_image(self._file(view), picture)
        coverage = self.capture.matte(view)
        truth = np.clip(self.capture.image(view), 0, 1)
        if truth.shape[:2] != picture.shape[:2]:
            truth = _shrunk(truth, camera)
            coverage = None if coverage is None else _shrunk(coverage[..., None], camera)[..., 0]
        image = picture.astype(np.float32) / 255
        key = (self.capture.path.resolve(), view.camera, view.frame, truth.shape)
        looked = finder if faces_camera(camera) else AvertedFinder()
        return Pair(image, truth, coverage=coverage, finder=looked, truth_key=key)

    def _file(self, view: View) -> Path:
        folder = self.pictures / view.camera
        folder.mkdir(parents=True, exist_ok=True)
        return folder / f"{view.frame:05d}.png"


def measure(
    scene: Scene, metrics: dict[str, Metric], finder: FaceFinder
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Every metric on every view.

    Returns:
        By name float64[K], NaN where a view could not be measured; and bool[K, 2] whether a face was found in
        the picture and in the truth (False where it was not looked for).
    """
    stills = {name: m for name, m in metrics.items() if not isinstance(m, JustObjectionableDifference)}
    film = next((m for m in metrics.values() if isinstance(m, JustObjectionableDifference)), None)
    numbers = {name: np.full(len(scene.views), np.nan) for name in metrics}
    faces = np.zeros((len(scene.views), 2), bool)
    looks = any(name in NEED_FACES for name in stills)
    sheet = None if scene.pictures is None else Sheet(len(scene.views))

    def pairs() -> Iterator[Pair]:
        for k, view in enumerate(progress(scene.views, "measuring", len(scene.views))):
            pair = scene.pair(view, finder)
            for name, metric in stills.items():
                value = metric.measure(pair)
                numbers[name][k] = np.nan if value is None else value
            if looks:
                faces[k] = [face is not None for face in (pair.faces.image, pair.faces.truth)]
            if sheet is not None:
                sheet.add(k, pair)
            yield pair
        if sheet is not None:
            sheet.write(scene.pictures / "sheet.png")

    stream = pairs()
    for run in runs(scene.views, [scene.camera(view) for view in scene.views]):
        if film is not None:
            numbers[film.name][run] = film.measure_video(stream, count=len(run), fps=scene.capture.fps)
        else:
            for _ in run:
                next(stream)
    next(stream, None)  # the last pair is dealt with when the next one is asked for
    return numbers, faces


def check_rig(capture: Capture, avatar: Avatar) -> None:
    """
    Raises:
        DataError: The capture's parameters are another rig's, or do not fit the avatar's.
    """
    source, name = capture.path / "fit.npz", capture.rig_name or RELEASED_RIG
    if name != avatar.rig_name:
        raise DataError(source, "rig_name", expected=f"{avatar.rig_name}, the avatar's", found=name)
    if capture.expr.shape[1] != avatar.bundle.n_expressions:
        expected = f"float32[T, {avatar.bundle.n_expressions}]"
        raise DataError(source, "expr", expected=expected, found=list(capture.expr.shape))


def _shrunk(image: np.ndarray, camera: Camera) -> np.ndarray:
    from cap4d.avatar.views import shrink

    return shrink(image, camera.width, camera.height).numpy()


def _facts(avatar: Path, capture: Path, scene: Scene) -> dict[str, Any]:
    mattes = sum(view.matte is not None for view in scene.views)
    sizes = {(camera.width, camera.height) for camera in map(scene.camera, scene.views)}
    return {
        "avatar": str(avatar),
        "capture": str(capture),
        "rig": scene.avatar.rig_name,
        "deformer": scene.avatar.tier,
        "gaussians": len(scene.avatar.bundle),
        "sizes": [list(size) for size in sorted(sizes)],
        "views_of_a_face": sum(faces_camera(scene.camera(view)) for view in scene.views),
        "background": f"white; the truth's taken away by its matte in {mattes} of {len(scene.views)} views",
        "masked": "full images; PSNR-fg alone is of the person's pixels",
        "command": sys.argv,
        "versions": _versions(),
    }


def _versions() -> dict[str, str]:
    found = {"python": sys.version.split()[0]}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
