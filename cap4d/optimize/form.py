"""Stores each tensor in the smallest form that costs next to nothing, and bases without what moves next to
nothing.

A file leaves out the points of a basis that stay put. Blendshapes fade out over most of a head: half of a
scanned rig's points move, by less than a hundredth of a millimetre for every second one of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.packing import FORMS
from cap4d.bundle.schema import GAUSSIANS, RIG, TENSORS
from cap4d.bundle.writer import PACKED
from cap4d.optimize.candidate import Candidate, with_subject
from cap4d.optimize.judge import Judge
from cap4d.rig.head import Subject

THRESHOLDS = (2e-4, 1e-4, 5e-5, 2e-5, 1e-5, 5e-6)  # m per unit of expression


def smallest_forms(candidate: Candidate, judge: Judge, limit: float, *, share: float) -> Candidate:
    """The candidate with packed tensors as int8 or float16, each where it adds at most a share of the limit.

    Args:
        limit: Of the pooled squared error, of all of it.
    """
    error = judge.error(candidate).pooled
    for name in _present(candidate):
        for trial in _smaller(candidate, name):
            found = judge.error(trial).pooled
            if found <= min(limit, error + share * limit):
                candidate, error = trial, found
                break
    return candidate


def sparser_bases(candidate: Candidate, judge: Judge, limit: float, *, share: float) -> Candidate:
    """The candidate with bases that hold still what they move by less than a threshold, the largest of
    `THRESHOLDS` that adds at most a share of the limit.
    """
    error = judge.error(candidate).pooled
    for threshold in THRESHOLDS:
        trial = replace(candidate, bundle=_thresholded(candidate, threshold))
        if judge.error(trial).pooled <= min(limit, error + share * limit):
            return trial
    return candidate


def _thresholded(candidate: Candidate, threshold: float) -> Bundle:
    def still(basis: np.ndarray | None) -> np.ndarray | None:
        if basis is None:
            return None
        moves = np.abs(basis).max(-1, keepdims=True) >= threshold
        return np.where(moves, basis, np.float32(0))

    def change(subject: Subject) -> Subject:
        bases = {name: still(getattr(subject, name)) for name in ("expression_basis", "pose_basis")}
        return replace(subject, **bases)

    bundle = with_subject(candidate.bundle, change)
    return replace(bundle, deform_linear=still(bundle.deform_linear))


def _present(candidate: Candidate) -> list[str]:
    bundle = candidate.bundle
    owners = {name: bundle.subject for name in TENSORS[RIG]} | {name: bundle for name in TENSORS[GAUSSIANS]}
    if candidate.tier == "linear":
        owners["deform_linear"] = bundle
    return [name for name in PACKED if name in owners and getattr(owners[name], name) is not None]


def _smaller(candidate: Candidate, name: str) -> Iterator[Candidate]:
    """From the smallest form on."""
    now = FORMS.index(candidate.forms.get(name, "float32"))
    for form in reversed(FORMS[now + 1 :]):
        yield replace(candidate, forms=dict(candidate.forms) | {name: form})
