"""Which metrics there are, and which can be had here."""

from __future__ import annotations

from collections.abc import Collection

from cap4d.bundle.bundle import Bundle
from cap4d.errors import ArgumentError
from cap4d.evaluate.faces import mediapipe_missing
from cap4d.evaluate.metrics import csim, fan, flame, jod, lpips, tracked
from cap4d.evaluate.metrics.blink import BlinkError
from cap4d.evaluate.metrics.gaze import GazeError
from cap4d.evaluate.metrics.keypoints import KeypointDistance
from cap4d.evaluate.metrics.metric import Metric, NotMeasured
from cap4d.evaluate.metrics.psnr import PersonPsnr, Psnr
from cap4d.evaluate.metrics.ssim import Ssim
from cap4d.evaluate.metrics.weights import Weights

PAPER_METRICS = ("PSNR", "LPIPS", "SSIM", "CSIM", "JOD", "AED", "APD", "AKD")
METRIC_NAMES = (*PAPER_METRICS, "gaze", "blink", "AKD-fan", "AED-mp", "APD-mp", "PSNR-fg")
LANDMARK_METRICS = (KeypointDistance, GazeError, BlinkError)
TRACKED_METRICS = ("AED-mp", "APD-mp")


def metrics_available(
    weights: Weights, *, bundle: Bundle | None = None, only: Collection[str] | None = None
) -> list[Metric | NotMeasured]:
    """Every metric, or why it cannot be had, in the order of `METRIC_NAMES`.

    Args:
        bundle: The avatar, which AED-mp and APD-mp are of.
        only: Names of those wanted; None: all.
    Raises:
        ArgumentError: An unknown name, or a file that was given is not there.
        DataError: A file that was given is no such network.
    """
    wanted = METRIC_NAMES if only is None else tuple(only)
    unknown = [name for name in wanted if name not in METRIC_NAMES]
    if unknown or not wanted:
        found = ", ".join(unknown) or "none"
        raise ArgumentError(f"metrics: expected some of {', '.join(METRIC_NAMES)}, got {found}")
    found = {metric.name: metric for metric in _found(weights, bundle, frozenset(wanted))}
    return [found[name] for name in METRIC_NAMES if name in wanted]


def _found(weights: Weights, bundle: Bundle | None, wanted: frozenset[str]) -> list[Metric | NotMeasured]:
    """At least those wanted; what is not wanted is not loaded where that would cost something."""
    metrics: list[Metric | NotMeasured] = [Psnr(), Ssim(), PersonPsnr(), *_of_landmarks()]
    finders = {"LPIPS": lpips.find, "CSIM": csim.find, "JOD": jod.find, "AKD-fan": fan.find}
    metrics += [find(weights) for name, find in finders.items() if name in wanted]
    if wanted & {"AED", "APD"}:
        metrics += flame.find(weights)
    if wanted & set(TRACKED_METRICS):
        metrics += _tracked(bundle)
    return metrics


def _of_landmarks() -> list[Metric | NotMeasured]:
    missing = mediapipe_missing()
    return [NotMeasured(kind.name, missing) if missing else kind() for kind in LANDMARK_METRICS]


def _tracked(bundle: Bundle | None) -> list[Metric | NotMeasured]:
    missing = mediapipe_missing()
    if missing:
        return [NotMeasured(name, missing) for name in TRACKED_METRICS]
    return list(tracked.find(bundle))
