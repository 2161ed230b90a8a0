"""Fitting an avatar to captures of a person: the loop around the trainer, and the files it leaves.

Beside `me.cap4d` stand `me.fit.json` (numbers), `me.fit.png` (held-out frames: truth, ours, nearest training
frame) and, while the fit runs, `me.fit.ckpt` and the one before it, `me.fit.ckpt.previous`.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from cap4d.avatar.corrections import corrections_named
from cap4d.avatar.device import device_named
from cap4d.avatar.journal import Journal
from cap4d.avatar.losses import Distance, Perceptual, gradient_distance
from cap4d.avatar.model import create_avatar
from cap4d.avatar.paint import paint
from cap4d.avatar.pause import pausing
from cap4d.avatar.presets import Preset, preset_named
from cap4d.avatar.references import Selection, select, split_selected, suited
from cap4d.avatar.report import FitReport, compare, peak_memory_mb, summarise, write_sheet
from cap4d.avatar.trainer import Trainer
from cap4d.avatar.views import FitView, Split, check_rig, is_video, load_views, split_views, spread
from cap4d.camera import opencv_from_rig
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError
from cap4d.perceptual.lpips import LPIPS_NEEDS, find_lpips, load_lpips
from cap4d.raster.threads import one_torch_thread
from cap4d.rig.grid import build_grid, own_triangles
from cap4d.rig.head import HeadRig

log = logging.getLogger(__name__)

ABLATIONS = (None, "unet", "lpips", "remesh", "mmdm")
PAINT_VIEWS = 16
REPORT_SECONDS = 10.0  # between progress lines
LOST_SECONDS = 600.0  # of work that a kill may cost, however slow the steps


def fit(
    captures: Sequence[Path],
    rig: HeadRig,
    output: Path,
    *,
    preset: str | Preset = "low",
    resume: bool = False,
    ablate: str | None = None,
    seed: int = 0,
    lpips_weights: Path | None = None,
    references: Sequence[tuple[str, int]] | None = None,
    hold_out: Sequence[str] = (),
    device: str = "auto",
    tiers: bool = True,
) -> FitReport:
    """Fits an avatar and writes it, its report and its picture.

    Args:
        captures: Folders of one person; the first one gives the identity, the idle clip and the default
            camera.
        rig: The head rig of the captures.
        output: `.cap4d` file to write.
        preset: Name of a preset, or one; a fit to few images adapts the short recipe's (`suited`).
        resume: Go on from the checkpoint of an interrupted fit, if there is one.
        ablate: `unet` leaves the deformation network out; `remesh` the UV grid too: the Gaussians ride on the
            rig's own triangles (`own_triangles`), as in GaussianAvatars; `lpips` the perceptual term; `mmdm`
            the generated captures, which are all but the first.
        seed: Same seed, same machine: same avatar.
        lpips_weights: Folder of LPIPS's weights; None looks into the usual places.
        references: (camera, frame) of the images of the first capture to train on; None: all that are not
            held out.
        hold_out: Cameras of the first capture that are never trained on.
        device: `auto`, `cpu` or `cuda` (see `device_named`).
        tiers: Also make the cheaper deformers for small machines (see `export_bundle`).
    Raises:
        ArgumentError: An unknown preset or ablation, or no frame to train on.
        DataError: A capture is malformed or of another rig, or the checkpoint of another fit.
    """
    started = time.monotonic()
    if not output.parent.is_dir() or output.is_dir():
        raise ArgumentError(f"output: expected a file in a folder that exists, got {output}")
    place = device_named(device)
    settings = settled(preset, ablate)
    perceptual = distance_of(settings.perceptual, lpips_weights, place)
    loaded = load_captures(captures[:1] if ablate == "mmdm" else captures, rig)
    selection = select(loaded[0], references, hold_out)
    split = split_captures(loaded, selection, settings.image_size)
    settings = suited(settings, len(split.train))
    trainer = prepare(loaded, split, rig, settings, ablate=ablate, seed=seed, perceptual=perceptual)
    kind = f"{kind_of(trainer, rig, ablate)}, data {fingerprint(loaded, settings, selection)}"
    journal = Journal(output.with_suffix(".fit.ckpt"), kind=kind, started=started)
    if resume:
        journal.take_up(trainer)
    trainer.move(place)
    log.info("%s", outlook(trainer, split, place))
    pace = run(trainer, lambda: journal.save(trainer))
    trainer.move(torch.device("cpu"))
    rest = {"device": place, "seconds": journal.seconds, "pace": pace, "tiers": tiers}
    report = finish(trainer, loaded[0], split, rig, output, ablate=ablate, **rest)
    journal.close()
    return report


def settled(preset: str | Preset, ablate: str | None) -> Preset:
    """The preset, without what is ablated of it.

    Raises:
        ArgumentError: An unknown preset or ablation.
    """
    if ablate not in ABLATIONS:
        raise ArgumentError(f"ablate: expected unet, lpips, remesh or mmdm, got {ablate!r}")
    settings = preset_named(preset) if isinstance(preset, str) else preset
    return replace(settings, perceptual=Perceptual()) if ablate == "lpips" else settings


def load_captures(paths: Sequence[Path], rig: HeadRig) -> list[Capture]:
    """
    Raises:
        ArgumentError: There are none.
        DataError: A capture is malformed or of another rig.
    """
    if not paths:
        raise ArgumentError("captures: expected at least one, got none")
    loaded = [Capture.load(path) for path in paths]
    for capture in loaded:
        check_rig(capture, rig)
    return loaded


def kind_of(trainer: Trainer, rig: HeadRig, ablate: str | None) -> str:
    """What a checkpoint says that it is of."""
    preset = trainer.preset
    missing = trainer.perceptual is None and preset.perceptual.kind != "none"
    left_out = ", without LPIPS" if missing else ""
    return f"preset {preset.name}{left_out}, rig {rig.name}, ablate {ablate}, seed {trainer.seed}"


def outlook(trainer: Trainer, split: Split, device: torch.device) -> str:
    """`fitting 80 images up to 256x256, 20 held out: preset low, recipe short, 2500 steps from 0, ...`"""
    preset = trainer.preset
    width, height = (max(getattr(v.camera, side) for v in split.train) for side in ("width", "height"))
    return (
        f"fitting {len(split.train)} images up to {width}x{height}, {len(split.held_out)} held out: "
        f"preset {preset.name}, recipe {preset.recipe}, {preset.iterations} steps from {trainer.step}, "
        f"{len(trainer.model)} Gaussians, on {device.type}"
    )


@one_torch_thread()
def prepare(
    captures: Sequence[Capture],
    split: Split,
    rig: HeadRig,
    preset: Preset,
    *,
    ablate: str | None,
    seed: int,
    perceptual: Distance | None = None,
) -> Trainer:
    """A trainer at step 0."""
    generator = torch.Generator().manual_seed(seed)
    model = create_avatar(
        rig,
        captures[0].shape,
        grid=own_triangles(rig) if ablate == "remesh" else build_grid(rig, preset.grid_size),
        gaussians=preset.gaussians,
        per_face=preset.per_face,
        sh_degree=preset.sh_degree,
        deformer_width=None if ablate in ("unet", "remesh") else preset.deformer_width,
        generator=generator,
    )
    pivot = opencv_from_rig(model.subject.neutral.mean(0)).numpy()
    corrections = [
        corrections_named(preset.corrections, c, _trained(i, c, split.train), pivot, video=is_video(c))
        for i, c in enumerate(captures)
    ]
    if preset.paint:
        some = spread(split.train, PAINT_VIEWS)
        with torch.no_grad():
            paint(model, some, [corrections[v.capture].at(v.frame).pose for v in some])
    return Trainer(model, corrections, split.train, preset, seed=seed, perceptual=perceptual)


def distance_of(
    perceptual: Perceptual, weights: Path | None, device: torch.device | None = None
) -> Distance | None:
    """What a perceptual term compares [0, 1] images by; None without one, or without the weights it needs.

    Raises:
        ArgumentError, DataError: The folder lacks weights, or they are not LPIPS's.
    """
    if perceptual.kind != "lpips":
        return gradient_distance if perceptual.kind == "gradient" else None
    files = find_lpips(weights)
    if files is None:
        log.warning("the fit goes on without its LPIPS term: %s", LPIPS_NEEDS)
        return None
    network = load_lpips(files).to(device)
    if perceptual.image_range == "compat":
        return network
    return lambda image, target: network(2 * image - 1, 2 * target - 1)


def split_captures(captures: Sequence[Capture], selection: Selection | None, image_size: int) -> Split:
    """The views to train on and those to be judged by."""
    if selection is None:
        return split_views(captures, load_views(captures, image_size))
    return split_selected(captures, selection, image_size)


def fingerprint(captures: Sequence[Capture], settings: Preset, selection: Selection | None = None) -> str:
    """Twelve hex digits that change with settings, selection and what was tracked: whose checkpoint it is."""
    digest = hashlib.sha256(repr(settings if selection is None else (settings, selection)).encode())
    for capture in captures:
        digest.update((capture.path / "fit.npz").read_bytes())
    return digest.hexdigest()[:12]


@one_torch_thread()
def run(trainer: Trainer, save: Callable[[], None]) -> float:
    """Steps to the end, saying where it is every few seconds and saving now and then.

    Returns:
        Mean time of a step, s.
    Raises:
        KeyboardInterrupt: Ctrl-C; the step it came in is finished and saved.
    """
    preset = trainer.preset
    begun, first = time.monotonic(), trainer.step
    spoke, saved, losses, pace = begun, begun, [], 0.0
    with pausing() as pause:
        while trainer.step < preset.iterations:
            losses.append(trainer.advance())
            now = time.monotonic()
            pace = (now - begun) / (trainer.step - first)
            if now - spoke > REPORT_SECONDS or trainer.step == preset.iterations:
                log.info("%s", progress(trainer, float(np.mean(losses)), pace))
                spoke, losses = now, []
            if pause.asked or trainer.step % preset.checkpoint_every == 0 or now - saved > LOST_SECONDS:
                save()
                saved = time.monotonic()
            if pause.asked:
                log.info("stopped after step %d: the same command with --resume goes on", trainer.step)
                raise KeyboardInterrupt
    return pace


def progress(trainer: Trainer, loss: float, pace: float) -> str:
    """Where a fit is; `pace` in seconds a step."""
    return (
        f"step {trainer.step}/{trainer.preset.iterations}  loss {loss:.4f}  {len(trainer.model)} Gaussians  "
        f"{1e3 * pace:.0f} ms a step  {memory(trainer.device)}  "
        f"{duration((trainer.preset.iterations - trainer.step) * pace)} left"
    )


def memory(device: torch.device) -> str:
    """`512 MB`, and what the GPU gave at most."""
    ours = f"{peak_memory_mb():.0f} MB"
    if device.type != "cuda":
        return ours
    return f"{ours} + {torch.cuda.max_memory_allocated(device) / 2**20:.0f} MB on the GPU"


def finish(
    trainer: Trainer,
    capture: Capture,
    split: Split,
    rig: HeadRig,
    output: Path,
    *,
    ablate: str | None,
    device: torch.device,
    seconds: Callable[[], float],
    pace: float,
    tiers: bool = True,
) -> FitReport:
    """Compares with the held-out frames and writes avatar, numbers and picture.

    Args:
        capture: The first one, whose clip and camera the avatar gets.
        device: Where it was fitted; the trainer is back on the CPU.
        seconds: How long it has taken.
        pace: Mean time of a step, s.
        tiers: See `fit`.
    """
    from cap4d.export.bundle import export_bundle

    comparison = compare(trainer, split) if split.held_out else None
    clip = trainer.corrections[0].corrected(capture.clip())
    export_bundle(trainer.model, output, rig=rig, capture=capture, clip=clip, tiers=tiers)
    if comparison is not None:
        write_sheet(comparison, output.with_suffix(".fit.png"))
    times = {"seconds": seconds(), "step_ms": 1e3 * pace}
    report = summarise(comparison, trainer, split, ablate=ablate, device=device.type, **times)
    report.write(output.with_suffix(".fit.json"))
    _announce(report, output)
    return report


def _announce(report: FitReport, output: Path) -> None:
    log.info(
        "%s: %d Gaussians, %s, %.0f ms a step, %.0f MB",
        *(output, report.gaussians, duration(report.seconds), report.step_ms, report.peak_memory_mb),
    )
    if report.held_out_psnr is not None:
        log.info(
            "held-out PSNR %.2f dB (mean %.2f, SSIM %.3f); nearest training frame %.2f dB (mean %.2f)",
            *(report.held_out_psnr, report.held_out_psnr_mean, report.held_out_ssim),
            *(report.nearest_frame_psnr, report.nearest_frame_psnr_mean),
        )


def _trained(index: int, capture: Capture, train: Sequence[FitView]) -> np.ndarray:
    marks = np.zeros(len(capture), bool)
    marks[[v.frame for v in train if v.capture == index]] = True
    return marks


def duration(seconds: float) -> str:
    """`75` -> `1:15`."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
