"""The road from a video or photos to a capture: look, recognise, solve, write."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cap4d.camera import Camera
from cap4d.capture.capture import Capture, save_capture
from cap4d.capture.folder import check_new_folder, new_folder
from cap4d.capture.image import read_image, write_image
from cap4d.errors import DataError
from cap4d.rig.head import HeadRig
from cap4d.track.correspondence import find_correspondence
from cap4d.track.dense import refine
from cap4d.track.footage import Footage, open_footage
from cap4d.track.landmarks import N_LANDMARKS, Detector, without_native_chatter
from cap4d.track.matte import refine_matte
from cap4d.track.neck import steady_neck
from cap4d.track.overlay import draw_overlay, write_video
from cap4d.track.progress import progress
from cap4d.track.solve import Observations, Solution, interpolate_invalid, reprojection_errors, solve

log = logging.getLogger(__name__)

MIN_DENSE_FRAMES = 5  # fewer frames say too little about what a point of the skin looks like


@dataclass(frozen=True)
class TrackReport:
    """What tracking found.

    Args:
        frames, tracked: Frames looked at, and those with a face.
        median_error, p95_error: Of the landmarks, px at an image of 512 px.
        focal: Focal length of each camera, px.
        seconds: Time taken.
    """

    frames: int
    tracked: int
    median_error: float
    p95_error: float
    focal: tuple[float, ...]
    seconds: float


def track(source: str | Path, rig: HeadRig, output: str | Path, *, overlay: bool = True) -> TrackReport:
    """Tracks the person in `source` with `rig` and writes a capture.

    Args:
        source: A video, an image, or a folder of photos of one person.
        rig: Any head rig.
        output: The capture to write, in a folder that exists; may be an empty folder, else must not exist.
        overlay: Also write overlay.mp4 (video) or overlay.png (photos).
    Raises:
        ArgumentError: `output` is taken or its parent does not exist, or `source` does not exist. Nothing was
            looked at or written.
        DataError: `source` cannot be read, or no frame shows a face.
    """
    start = time.monotonic()
    check_new_folder(Path(output))
    footage = open_footage(source)
    with new_folder(Path(output)) as folder:
        observations = _look(footage, folder)
        log.info("%s: a face in %d of %d frames", source, observations.valid.sum(), len(observations.valid))
        with without_native_chatter():
            correspondence = find_correspondence(rig)
        observations = replace(observations, known=correspondence.known)
        points = rig.resample(correspondence.vertices, correspondence.bary)
        log.info("solving for %d frames", len(observations.valid))
        solution = solve(points, observations)
        if footage.is_video and observations.valid.sum() >= MIN_DENSE_FRAMES:
            log.info("refining on the skin")
            solution = refine(
                rig, points, observations, solution, lambda t: _stored_image(folder, observations, t)
            )
        solution = interpolate_invalid(solution, observations.valid)
        errors = reprojection_errors(points, observations, solution)
        _write(folder, footage, rig, observations, solution, float(np.nanmedian(errors)))
        if overlay:
            _write_overlay(folder, footage, rig, observations)
        report = TrackReport(
            frames=len(observations.valid),
            tracked=int(observations.valid.sum()),
            median_error=float(np.nanmedian(errors)),
            p95_error=float(np.nanpercentile(errors, 95)),
            focal=tuple(solution.focal.tolist()),
            seconds=time.monotonic() - start,
        )
    log.info(
        "%s: %d of %d frames tracked, landmark error at 512 px: median %.2f px, p95 %.2f px; %.0f s",
        *(output, report.tracked, report.frames, report.median_error, report.p95_error, report.seconds),
    )
    return report


def _look(footage: Footage, folder: Path) -> Observations:
    """Writes images and mattes, and finds the face in each."""
    points, sizes = [], []
    with without_native_chatter(), Detector(video=footage.is_video) as detector:
        for frame, image in enumerate(progress(footage.frames(), "looking", footage.count)):
            sizes.append(image.shape[1::-1])
            camera = _camera_of(footage, sizes)[-1]
            for kind in ("images", "bg"):
                (folder / kind / f"cam{camera}").mkdir(parents=True, exist_ok=True)
            write_image(folder / f"images/cam{camera}/{frame:05d}.png", image)
            matte = refine_matte(image, detector.matte(image))
            write_image(folder / f"bg/cam{camera}/{frame:04d}.png", matte)
            points.append(detector.landmarks(image))
    if not points:
        raise DataError(footage.source, "video", expected="frames", found="none")
    valid = np.array([p is not None for p in points])
    if not valid.any():
        raise DataError(footage.source, "images", expected="a face", found=f"none in {len(points)}")
    found = np.stack([np.zeros((N_LANDMARKS, 2)) if p is None else p for p in points])
    return Observations(found, valid, np.array(sizes), _camera_of(footage, sizes), footage.is_video)


def _stored_image(folder: Path, observations: Observations, frame: int) -> np.ndarray:
    """uint8[H, W, 3]"""
    path = folder / f"images/cam{observations.camera_of[frame]}/{frame:05d}.png"
    return np.rint(read_image(path) * 255).astype(np.uint8)


def _camera_of(footage: Footage, sizes: list[tuple[int, int]]) -> np.ndarray:
    """int[T]: photos of one size share a camera, as do all frames of a video."""
    known = list(dict.fromkeys(sizes))
    if footage.is_video and len(known) > 1:
        raise DataError(footage.source, "video", expected=f"frames of {known[0]}", found=known[-1])
    return np.array([known.index(size) for size in sizes])


def _write(
    folder: Path, footage: Footage, rig: HeadRig, observations: Observations, solution: Solution, error: float
) -> None:
    camera_of, valid = observations.camera_of, observations.valid
    cameras = {}
    for c, focal in enumerate(solution.focal):
        width, height = map(int, observations.sizes[np.argmax(camera_of == c)])
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras[f"cam{c}"] = Camera(K, np.eye(4), width, height)
    neck = steady_neck(rig, solution.shape, solution.rot, solution.tra) if footage.is_video else None
    save_capture(
        folder,
        rig_name=rig.name,
        shape=solution.shape,
        expr=solution.expr,
        rot=solution.rot,
        tra=solution.tra,
        eye_rot=solution.eye_rot,
        neck_rot=neck,
        cameras=cameras,
        fps=footage.fps,
        valid=(camera_of[None] == np.arange(len(cameras))[:, None]) & valid,
        error=error,
        references=[(f"cam{camera_of[t]}", t) for t in np.flatnonzero(valid)],
    )


def _write_overlay(folder: Path, footage: Footage, rig: HeadRig, observations: Observations) -> None:
    capture = Capture.load(folder)
    views = progress(capture.views, "drawing", len(capture.views))
    frames = (draw_overlay(capture, rig, view, observations.points[view.frame]) for view in views)
    if footage.is_video:
        write_video(folder / "overlay.mp4", frames, footage.fps)
        return
    pictures = list(frames)
    width = max(picture.shape[1] for picture in pictures)
    padded = [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0)), constant_values=255) for p in pictures]
    write_image(folder / "overlay.png", np.concatenate(padded))
