"""The cheapest deformer whose pictures are near enough."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.onnx_half import halve_weights
from cap4d.export.distill import distill
from cap4d.export.expressions import own_expressions
from cap4d.export.tiers import with_tiers
from cap4d.optimize.candidate import Candidate
from cap4d.optimize.judge import Judge
from cap4d.player.deformer import Deformer

log = logging.getLogger(__name__)


def with_cheaper_tiers(bundle: Bundle) -> Bundle:
    """The bundle with the cheaper forms of its network, made from its idle clip if it has none of them."""
    if bundle.deform_onnx is None or bundle.deform_int8 is not None or bundle.deform_linear is not None:
        return bundle
    try:
        return with_tiers(bundle)
    except LookupError:  # it does not have the layers that a U-Net of ours has
        log.info("deformer: the network is not one of ours: no int8")
    network = Deformer(bundle.deform_onnx, size=bundle.grid.size)
    return replace(bundle, deform_linear=distill(bundle, network, own_expressions(bundle)[0]))


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
