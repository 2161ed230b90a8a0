"""Takes Gaussians out, those first that would be missed least, while the pictures stay near enough."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.optimize.candidate import Candidate, with_gaussians
from cap4d.optimize.judge import Judge
from cap4d.optimize.refine import refined
from cap4d.optimize.removal import removal_errors
from cap4d.optimize.unused import without_bare_faces

AT_ONCE = 0.08  # of the Gaussians, in a round
LEAST = 0.03  # what is not worth a round
REFINE_STEPS = 48
ROUNDS = 60

log = logging.getLogger(__name__)


def prune(
    candidate: Candidate, judge: Judge, limit: float, *, enough: Callable[[Candidate], bool] = lambda _: False
) -> Candidate:
    """The candidate with as few Gaussians as the limit of the pooled squared error allows.

    In rounds: Gaussians stand in for each other, so that what one of them is worth depends on which are left
    (removing half at once costs 8 dB more than in rounds of a twentieth). Where a round goes beyond the
    limit, those that are left are refined; where that does not bring it back, the next round takes half as
    many.

    Args:
        enough: Ends it early.
    """
    scene, share = judge.scene(candidate), AT_ONCE
    for round_ in range(ROUNDS):
        if share < LEAST or len(candidate.bundle) == 1 or enough(candidate):
            break
        errors = removal_errors(candidate.bundle, scene, seed=round_)
        trial = replace(candidate, bundle=_without_least(candidate.bundle, errors, share))
        found = judge.error(trial)
        if found.pooled > limit:
            trial = replace(trial, bundle=refined(trial.bundle, scene, steps=REFINE_STEPS))
            found = judge.error(trial)
        kept = found.pooled <= limit
        if kept:
            candidate = trial
        else:
            share /= 2
        word = "left" if kept else "would be too few"
        log.info("prune: %d Gaussians %s, %.2f dB", len(trial.bundle), word, found.psnr)
    return replace(candidate, bundle=without_bare_faces(candidate.bundle))


def _without_least(bundle: Bundle, errors: np.ndarray, share: float) -> Bundle:
    order = np.argsort(errors, kind="stable")
    count = min(max(1, int(share * len(order))), len(order) - 1)
    return with_gaussians(bundle, np.sort(order[count:]))
