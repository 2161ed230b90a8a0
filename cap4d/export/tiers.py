"""The cheaper forms of a bundle's deformation network, made from it, and how far each is from it in mm."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.onnx_half import halve_weights
from cap4d.drive.clip import Clip
from cap4d.export.distill import distill
from cap4d.export.expressions import Expressions, OwnExpressions, offset_maps, own_expressions
from cap4d.player.avatar import Avatar
from cap4d.player.deformer import Deformer
from cap4d.track.progress import progress

log = logging.getLogger(__name__)

CALIBRATION = (24, 12, 12)  # frames, jittered frames and single expressions that int8's ranges are taken from


def with_tiers(bundle: Bundle, clips: Sequence[Clip] = ()) -> Bundle:
    """The bundle with all that can stand in for its network, and their errors.

    Args:
        bundle: It has a network with float32 weights, or none: then it comes back as it is.
        clips: What the avatar was made from, besides its idle clip.
    Raises:
        ArgumentError: A package that making them needs is not installed.
    """
    if bundle.deform_onnx is None:
        return bundle
    from cap4d.export.quantize import quantize

    started = time.monotonic()
    fit, held_out = own_expressions(bundle, clips)
    network = Deformer(bundle.deform_onnx, size=bundle.grid.size)
    calibration = np.stack(list(offset_maps(bundle, some(fit, CALIBRATION))))
    bundle = replace(
        bundle,
        deform_linear=distill(bundle, network, fit),
        deform_int8=quantize(bundle.deform_onnx, calibration),
    )
    known = {tier: errors for tier, errors in bundle.tier_errors.items() if tier == "full"}
    bundle = replace(bundle, tier_errors=known | tier_errors(bundle, held_out.all()))
    log.info(
        "cheaper deformers made in %.1f s; vertices are off by (RMS, at most):", time.monotonic() - started
    )
    for tier, (rms, worst) in bundle.tier_errors.items():
        log.info("  %-6s %.4f mm, %.3f mm", tier, rms, worst)
    return bundle


def tier_errors(bundle: Bundle, expressions: Expressions) -> dict[str, tuple[float, float]]:
    """How far the deformable vertices of every tier but `full` are from those of `full`: (RMS, largest), mm.

    Args:
        bundle: With a float32 network; `fp16` is measured on its weights rounded.
        expressions: Where; none that a tier was made from.
    """
    tiers = {tier: bundle for tier in bundle.tiers if tier != "full"}
    tiers = {"fp16": replace(bundle, deform_onnx=halve_weights(bundle.deform_onnx)), **tiers}
    expected = vertices(bundle, "full", expressions)
    return {tier: distance(vertices(held, tier, expressions), expected) for tier, held in tiers.items()}


def vertices(bundle: Bundle, tier: str, expressions: Expressions) -> np.ndarray:
    """float32[n, D, 3] m the deformable vertices as the player poses them."""
    avatar, deformable = Avatar(bundle, deformer=tier), bundle.grid.deformable
    moments = zip(expressions.expr, expressions.eye_rot, expressions.jaw_rot, strict=True)
    moments = progress(moments, f"checking the {tier} deformer", len(expressions))
    return np.stack([avatar.vertices(e, eye_rot=eyes, jaw_rot=jaw)[deformable] for e, eyes, jaw in moments])


def distance(found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Root mean square and largest distance of points [n, D, 3] m, mm; zeros where there is none."""
    squares = np.square(found.astype(np.float64) - expected).sum(-1)
    if not squares.size:
        return 0.0, 0.0
    return 1e3 * float(np.sqrt(squares.mean())), 1e3 * float(np.sqrt(squares.max()))


def some(own: OwnExpressions, counts: Sequence[int]) -> Expressions:
    """So many frames, jittered frames and single expressions, evenly."""
    kinds = zip((own.frames, own.jittered, own.singles), counts, strict=True)
    return Expressions.joined(
        [kind.at(np.linspace(0, len(kind) - 1, min(n, len(kind))).round().astype(int)) for kind, n in kinds]
    )
