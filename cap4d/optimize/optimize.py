"""`cap4d optimize`: the full avatar in, one that is smaller and plays faster out, to a stated error.

Steps go from what costs least to what takes whatever error is left: what is never used, the deformer's tier,
the forms of the tensors, the degree of the harmonics, the number of Gaussians. Each is kept only while the
pooled error against the full avatar stays within its part of the limit.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from cap4d.atomic import replacing
from cap4d.bundle.reader import read_bundle
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError
from cap4d.gaussians import SH_COUNTS
from cap4d.optimize.candidate import Candidate
from cap4d.optimize.degree import at_degree
from cap4d.optimize.form import smallest_forms, sparser_bases
from cap4d.optimize.judge import Judge
from cap4d.optimize.prune import prune
from cap4d.optimize.report import Report, Step, change, counts
from cap4d.optimize.tier import cheapest_tier, with_cheaper_tiers
from cap4d.optimize.unused import without_unused

TIER_SHARE, FORM_SHARE, DEGREE_SHARE = 0.5, 0.03, 0.2
"""Of the limit on the squared error: what the deformer may take, what each tensor's form and what a lower
degree may add. The number of Gaussians takes the rest."""
FIRST_DB, LAST_DB, STEP_DB = 60.0, 20.0, 2.5  # limits that `--max-size` tries

log = logging.getLogger(__name__)


def optimize(
    path: Path,
    output: Path,
    *,
    max_error_db: float | None = None,
    max_bytes: int | None = None,
    capture: Path | None = None,
) -> Report:
    """Reads `path`, writes a smaller `output`.

    Args:
        max_error_db: The PSNR of the pictures that must be kept, dB; or
        max_bytes: the size that the file must have, to the least error that is found.
        capture: The avatar's training views are looked at too.
    Raises:
        ArgumentError: Not one of the two is given, `output` is `path`, or no file is that small.
        DataError: `path` or `capture` is not sound.
    """
    if (max_error_db is None) == (max_bytes is None):
        raise ArgumentError("optimize: expected one of --max-error and --max-size")
    if output.exists() and path.exists() and output.samefile(path):
        raise ArgumentError(f"{output}: expected another file than the avatar itself")
    bundle = read_bundle(path)
    captured = None if capture is None else Capture.load(capture)
    with replacing(output) as temporary:
        road = _Road(Judge(bundle, captured), path.stat().st_size, Candidate(bundle, bundle.tiers[0], {}))
        if max_bytes is None:
            road.go(max_error_db)
        else:
            road.go_until(max_bytes)
        road.candidate.write(temporary)
    return Report(tuple(road.steps), road.judge.error_beyond(road.candidate).psnr)


class _Road:
    """A candidate, the judge, and the steps taken so far."""

    def __init__(self, judge: Judge, size: int, full: Candidate) -> None:
        self.judge, self.candidate = judge, full
        error = judge.error(full)
        self.steps = [Step("full avatar", counts(full), size, error.psnr, error.worst)]

    def go(self, limit_db: float, *, enough: Callable[[Candidate], bool] = lambda _: False) -> None:
        """All steps within a limit; ends as soon as it is `enough`."""
        limit = 10 ** (-limit_db / 10)
        steps: dict[str, Callable[[Candidate], Candidate]] = {
            "unused": lambda c: replace(c, bundle=without_unused(c.bundle)),
            "deformer": lambda c: self._cheapest_tier(c, TIER_SHARE * limit),
            "bases": lambda c: sparser_bases(c, self.judge, limit, share=FORM_SHARE),
            "forms": lambda c: smallest_forms(c, self.judge, limit, share=FORM_SHARE),
            "degree": lambda c: self._lowest_degree(c, limit),
            "prune": lambda c: prune(c, self.judge, limit, enough=enough),
        }
        for name, step in steps.items():
            if not enough(self.candidate):
                self._take(name, step, limit)

    def go_until(self, max_bytes: int) -> None:
        """Limits from strict to loose, until the file fits.

        Raises:
            ArgumentError: It does not at the loosest.
        """

        def fits(candidate: Candidate) -> bool:
            return candidate.size() <= max_bytes

        limit_db = FIRST_DB
        while not fits(self.candidate):
            if limit_db < LAST_DB:
                expected = f"at least {self.candidate.size() / 1e6:.2f} MB, which is {LAST_DB:g} dB"
                raise ArgumentError(f"max-size: expected {expected}, got {max_bytes / 1e6:.2f} MB")
            self.go(limit_db, enough=fits)
            limit_db -= STEP_DB

    def _take(self, name: str, step: Callable[[Candidate], Candidate], limit: float) -> None:
        """Takes a step, unless it changes nothing or goes beyond the limit."""
        before, after = self.candidate, step(self.candidate)
        detail = change(before, after)
        error = self.judge.error(after)
        if detail and error.pooled <= limit:
            self.candidate = after
            self.steps.append(Step(name, detail, after.size(), error.psnr, error.worst))
            log.info("%s: %s; %.2f MB, %.2f dB", name, detail, self.steps[-1].size / 1e6, error.psnr)
        else:
            log.info("%s: nothing", name)

    def _cheapest_tier(self, candidate: Candidate, limit: float) -> Candidate:
        return cheapest_tier(
            replace(candidate, bundle=with_cheaper_tiers(candidate.bundle)), self.judge, limit
        )

    def _lowest_degree(self, candidate: Candidate, limit: float) -> Candidate:
        now = SH_COUNTS[candidate.bundle.sh.shape[1]]
        if now == 0:
            return candidate
        scene, error = self.judge.scene(candidate), self.judge.error(candidate).pooled
        for degree in range(now):
            trial = replace(candidate, bundle=at_degree(candidate.bundle, scene, degree))
            if self.judge.error(trial).pooled <= min(limit, error + DEGREE_SHARE * limit):
                return trial
        return candidate
