"""The cheapest deformer whose pictures are near enough."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.onnx_half import halve_weights
from cap4d.errors import Cap4dError
from cap4d.export.distill import distill
from cap4d.export.expressions import offset_maps, own_expressions
from cap4d.export.quantize import quantize
from cap4d.optimize.candidate import Candidate
from cap4d.optimize.judge import Judge
from cap4d.player.tiers import choose_tier

QUANTIZED_FROM = 64  # expressions

log = logging.getLogger(__name__)


def with_cheaper_tiers(bundle: Bundle) -> Bundle:
    """The bundle with int8 and linear forms of its network, made from its idle clip where it has none."""
    if bundle.deform_onnx is None:
        return bundle
    fit, _ = own_expressions(bundle)
    if bundle.deform_linear is None:
        _, network = choose_tier(bundle, "auto", threads=0, source="avatar", budget_ms=math.inf)
        bundle = replace(bundle, deform_linear=distill(bundle, network, fit))
    if bundle.deform_int8 is None:
        try:
            own = fit.all()
            some = np.linspace(0, len(own) - 1, min(QUANTIZED_FROM, len(own))).round().astype(int)
            maps = np.stack(list(offset_maps(bundle, own.at(some))))
            bundle = replace(bundle, deform_int8=quantize(bundle.deform_onnx, maps))
        except (LookupError, ValueError, Cap4dError) as error:
            log.info("int8: left out, the network is not one of ours (%s)", error)
    return bundle


def cheapest_tier(candidate: Candidate, judge: Judge, limit: float) -> Candidate:
    """The candidate with the cheapest deformer that keeps the pooled squared error below a limit; or as it
    was.
    """
    for trial in _cheaper(candidate):
        if judge.error(trial).pooled <= limit:
            return trial
    return candidate


def _cheaper(candidate: Candidate) -> Iterator[Candidate]:
    """From the cheapest on, all that are cheaper than the candidate's."""
    tiers = candidate.bundle.tiers
    for tier in reversed(tiers[tiers.index(candidate.tier) + 1 :]):
        yield replace(candidate, tier=tier)
    if candidate.tier == "full":
        halved = halve_weights(candidate.bundle.deform_onnx)
        yield Candidate(replace(candidate.bundle, deform_onnx=halved), "fp16", candidate.forms)
