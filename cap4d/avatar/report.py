"""What a fit is worth: its pictures of held-out frames beside the truth and the nearest training frames."""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from cap4d.atomic import replacing
from cap4d.avatar.trainer import Trainer
from cap4d.avatar.views import FitView, Split, spread
from cap4d.capture.image import write_image
from cap4d.evaluate.image import mse, pooled_psnr, psnr_of_mse, ssim

SHEET_ROWS = 6
TRAIN_VIEWS = 16  # training frames that train_psnr looks at
LEAST_MSE = 1e-10  # a frame repeated to the bit counts as 100 dB, not as infinity


@dataclass(frozen=True)
class FitReport:
    """The numbers of a fit, as they are written to `.fit.json`. PSNRs in dB; None where no frame is held out.

    The fit never sees a held-out image. Its expression, gaze, pose and matte come from the tracker, which saw
    all frames, as in the field's usual protocol; so do the identity and the focal length.

    Args:
        perceptual: What the perceptual term compared images by, `lpips` or `gradient`; `none` without one,
            or without LPIPS's weights.
        held_out_psnr: Of the squared error pooled over all pixels of all held-out frames.
        nearest_frame_psnr: The same for the baseline: for every held-out frame the training frame of the same
            size that resembles it most (least squared error, so it is the best that replaying could do).
        nearest_in_time_psnr: The same for the training frame nearest in time.
        held_out_psnr_mean, nearest_frame_psnr_mean: Means of the frames' own PSNRs.
        held_out_ssim: Mean SSIM.
        between, tail: The same numbers for held-out frames with training frames on both sides in time, and
            for those after the last training frame.
        train_psnr: Pooled over some training frames.
        seconds: Wall time of the fit.
        step_ms: Mean wall time of a step, of those since the last resume.
        device: `cpu` or `cuda`.
        peak_memory_mb: Greatest resident memory of the process.
    """

    preset: str
    recipe: str
    perceptual: str
    ablate: str | None
    iterations: int
    gaussians: int
    train_frames: int
    held_out_frames: int
    held_out_psnr: float | None
    nearest_frame_psnr: float | None
    nearest_in_time_psnr: float | None
    held_out_psnr_mean: float | None
    nearest_frame_psnr_mean: float | None
    held_out_ssim: float | None
    between: dict[str, float]
    tail: dict[str, float]
    train_psnr: float
    seconds: float
    step_ms: float
    device: str
    peak_memory_mb: float

    def write(self, path: Path) -> None:
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1, allow_nan=False) + "\n")


@dataclass(frozen=True, eq=False)
class Comparison:
    """Held-out frames beside our pictures and the baselines.

    Args:
        truth, ours, nearest: float32[H, W, 3] per frame.
        errors: {"ours", "nearest", "time"} -> float64[K] mean squared errors.
        pixels: float64[K] pixels of the frames, which weight their errors in a pool.
        ssim: float64[K] of ours.
        tail: bool[K] frames after the last training frame.
    """

    truth: list[np.ndarray]
    ours: list[np.ndarray]
    nearest: list[np.ndarray]
    errors: dict[str, np.ndarray]
    pixels: np.ndarray
    ssim: np.ndarray
    tail: np.ndarray

    def summary(self, mask: np.ndarray) -> dict[str, float]:
        """The numbers of a subset of the frames; empty for none."""
        if not mask.any():
            return {}
        e = {name: values[mask] for name, values in self.errors.items()}
        share = self.pixels[mask] / self.pixels[mask].mean()
        return {
            "frames": int(mask.sum()),
            "held_out_psnr": pooled_psnr(share * e["ours"]),
            "nearest_frame_psnr": pooled_psnr(share * e["nearest"]),
            "nearest_in_time_psnr": pooled_psnr(share * e["time"]),
            "held_out_psnr_mean": _mean_psnr(e["ours"]),
            "nearest_frame_psnr_mean": _mean_psnr(e["nearest"]),
            "held_out_ssim": float(self.ssim[mask].mean()),
        }


def render_views(trainer: Trainer, views: Sequence[FitView]) -> list[np.ndarray]:
    """float32[H, W, 3] in [0, 1] of each view, with its frame's corrections."""
    with torch.no_grad():
        return [trainer.render(view)[1].rgb.clamp(0, 1).numpy() for view in views]


def compare(trainer: Trainer, split: Split) -> Comparison:
    """Renders every held-out frame and finds its baselines among the training frames."""
    ours = render_views(trainer, split.held_out)
    truth = [view.target.numpy() for view in split.held_out]
    by_pixels, by_time = zip(*(_baselines(view, split.train) for view in split.held_out), strict=True)
    errors = {
        name: np.array([max(LEAST_MSE, mse(a, b)) for a, b in zip(images, truth, strict=True)])
        for name, images in (("ours", ours), ("nearest", by_pixels), ("time", by_time))
    }
    similar = np.array([ssim(a, b) for a, b in zip(ours, truth, strict=True)])
    pixels = np.array([image.size for image in truth], np.float64)
    return Comparison(truth, ours, list(by_pixels), errors, pixels, similar, split.tail)


def _baselines(view: FitView, train: Sequence[FitView]) -> tuple[np.ndarray, np.ndarray]:
    """The training image most like `view`'s, and the one nearest in time (the more alike of two as near)."""
    target = view.target
    like = [t for t in train if t.pixels.shape == view.pixels.shape]
    if not like:
        white = np.ones(target.shape, np.float32)
        return white, white
    errors = [float((t.target - target).square().mean()) for t in like]
    best = min(range(len(like)), key=errors.__getitem__)
    apart = [(t.capture != view.capture, abs(t.frame - view.frame)) for t in like]
    soonest = min(range(len(like)), key=lambda i: (*apart[i], errors[i]))
    return like[best].target.numpy(), like[soonest].target.numpy()


def summarise(
    comparison: Comparison | None,
    trainer: Trainer,
    split: Split,
    *,
    ablate: str | None,
    seconds: float,
    step_ms: float,
    device: str,
) -> FitReport:
    """Puts the report together; `comparison` is None where nothing is held out."""
    everything = between = tail = {}
    if comparison is not None:
        everything = comparison.summary(np.ones_like(comparison.tail))
        between, tail = comparison.summary(~comparison.tail), comparison.summary(comparison.tail)
    some = spread(split.train, TRAIN_VIEWS)
    pictures = render_views(trainer, some)
    train_errors = [max(LEAST_MSE, mse(a, v.target.numpy())) for a, v in zip(pictures, some, strict=True)]
    names = ("held_out_psnr", "nearest_frame_psnr", "nearest_in_time_psnr", "held_out_psnr_mean")
    names += ("nearest_frame_psnr_mean", "held_out_ssim")
    return FitReport(
        preset=trainer.preset.name,
        recipe=trainer.preset.recipe,
        perceptual="none" if trainer.perceptual is None else trainer.preset.perceptual.kind,
        ablate=ablate,
        iterations=trainer.step,
        gaussians=len(trainer.model),
        train_frames=len(split.train),
        held_out_frames=len(split.held_out),
        **{name: everything.get(name) for name in names},
        between=between,
        tail=tail,
        train_psnr=pooled_psnr(np.array(train_errors)),
        seconds=round(seconds, 1),
        step_ms=round(step_ms, 1),
        device=device,
        peak_memory_mb=round(peak_memory_mb(), 1),
    )


def write_sheet(comparison: Comparison, path: Path) -> None:
    """A picture for the eye: rows of held-out frames; truth, ours, nearest training frame."""
    chosen = np.unique(np.linspace(0, len(comparison.truth) - 1, SHEET_ROWS).round().astype(int))
    sources = (comparison.truth, comparison.ours, comparison.nearest)
    height = min(comparison.truth[i].shape[0] for i in chosen)
    width = min(comparison.truth[i].shape[1] for i in chosen)
    rows = [np.concatenate([images[i][:height, :width] for images in sources], 1) for i in chosen]
    write_image(path, np.concatenate(rows))


def peak_memory_mb() -> float:
    """Greatest resident size of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _mean_psnr(errors: np.ndarray) -> float:
    return float(np.mean([psnr_of_mse(e) for e in errors]))
