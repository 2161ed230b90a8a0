"""What `cap4d optimize` did, for people."""

from __future__ import annotations

from dataclasses import dataclass

from cap4d.bundle.bundle import Bundle
from cap4d.gaussians import SH_COUNTS
from cap4d.optimize.candidate import Candidate


@dataclass(frozen=True)
class Step:
    """What a step did.

    Args:
        name: Of the step.
        detail: What it removed.
        size: Bytes of the file after it.
        psnr, worst: Of all shots together and of the worst, dB, after it.
    """

    name: str
    detail: str
    size: int
    psnr: float
    worst: float


@dataclass(frozen=True)
class Report:
    """All steps that changed anything, the full avatar first; and the PSNR on expressions beyond its clip,
    dB.
    """

    steps: tuple[Step, ...]
    beyond: float


def table(report: Report) -> str:
    """The report as text: for each step what it removed, bytes before and after, and what it cost."""
    lines = [f"{'step':<12} {'bytes before':>13} {'after':>12} {'dB':>7} {'cost':>6} {'worst':>7}  what went"]
    before = None
    for step in report.steps:
        size = "" if before is None else f"{before.size:,}"
        cost = "" if before is None else f"{step.psnr - before.psnr:+.1f}"
        lines.append(
            f"{step.name:<12} {size:>13} {step.size:>12,} {step.psnr:>7.2f} {cost:>6} {step.worst:>7.2f}"
            f"  {step.detail}"
        )
        before = step
    first, last = report.steps[0], report.steps[-1]
    lines.append(
        f"{first.size / last.size:.1f} times smaller; {last.psnr:.2f} dB, worst frame {last.worst:.2f} dB; "
        f"{report.beyond:.2f} dB on expressions that the clip does not show"
    )
    return "\n".join(lines)


def counts(candidate: Candidate) -> str:
    """What a candidate is, for people."""
    b = candidate.bundle
    return f"{len(b):,} Gaussians of degree {SH_COUNTS[b.sh.shape[1]]}, deformer {candidate.tier}"


def change(before: Candidate, after: Candidate) -> str:
    """What differs, for people; nothing if nothing does."""
    a, b, changes = before.bundle, after.bundle, []
    if before.tier != after.tier:
        changes.append(f"deformer {before.tier} -> {after.tier}")
    if before.forms != after.forms:
        by_form: dict[str, list[str]] = {}
        for name, form in after.forms.items():
            if form != before.forms.get(name):
                by_form.setdefault(form, []).append(name)
        changes += [f"{form}: {', '.join(names)}" for form, names in by_form.items()]
    if a.sh.shape[1] != b.sh.shape[1]:
        changes.append(f"degree {SH_COUNTS[a.sh.shape[1]]} -> {SH_COUNTS[b.sh.shape[1]]}")
    if len(a) != len(b):
        changes.append(f"{len(a):,} -> {len(b):,} Gaussians")
    if len(a.grid.faces) != len(b.grid.faces):
        changes.append(f"{len(a.grid.faces):,} -> {len(b.grid.faces):,} faces")
    if _moving(b) < _moving(a):
        changes.append(f"{1 - _moving(b) / _moving(a):.0%} of the points that bases move")
    for name in ("pose_offset", "pose_basis", "expr_rotation"):
        if getattr(a.subject, name) is not None and getattr(b.subject, name) is None:
            changes.append(name)
    return "; ".join(changes)


def _moving(bundle: Bundle) -> int:
    """Points times rows that are not zero, of all bases."""
    subject = bundle.subject
    bases = (subject.expression_basis, subject.pose_basis, bundle.deform_linear)
    return sum(int(basis.any(-1).sum()) for basis in bases if basis is not None)
