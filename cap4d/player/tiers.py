"""Which form of the deformation network plays: the one asked for, or the most exact that keeps up here."""

from __future__ import annotations

import math
from dataclasses import replace

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.schema import INT8, ONNX
from cap4d.errors import ArgumentError
from cap4d.player.deformer import Deformer
from cap4d.rig.head import Subject

CHOICES = ("auto", "full", "fp16", "int8", "linear", "off")
BUDGET_MS = 8.0  # of a pass for `auto`: half a frame at 60 a second, the other half is the renderer's


def choose_tier(
    bundle: Bundle, wanted: str, *, threads: int, source: str, budget_ms: float = BUDGET_MS
) -> tuple[str, Deformer | None]:
    """The name of a tier and its network, which `linear` and `off` do without.

    `auto` is the most exact network of which a pass stays within the budget on this machine, measured now;
    where none does, the least exact one (int8 where there is one). It is `linear` only where there is no
    network, and `off` where there is nothing.

    Args:
        wanted: One of `CHOICES`.
        threads: See `Deformer`.
        source: The bundle's file, for error messages.
        budget_ms: Infinity takes the most exact network unmeasured, the same on every machine.
    Raises:
        ArgumentError: There is no such tier, or the avatar does not have it.
        DataError: The network does not load.
    """
    held = bundle.tiers
    if wanted not in CHOICES:
        raise ArgumentError(f"deformer: expected one of {', '.join(CHOICES)}, got {wanted}")
    if wanted != "auto" and wanted not in held:
        has = ", ".join(held)
        raise ArgumentError(f"deformer: expected one that {source} has ({has}, or auto), got {wanted}")

    def load(tier: str) -> Deformer | None:
        networks = {"full": (bundle.deform_onnx, ONNX), "fp16": (bundle.deform_onnx, ONNX)}
        network, entry = (networks | {"int8": (bundle.deform_int8, INT8)}).get(tier, (None, ""))
        if network is None:
            return None
        return Deformer(network, size=bundle.grid.size, source=f"{source}:{entry}", threads=threads)

    if wanted != "auto":
        return wanted, load(wanted)
    networks = [tier for tier in held if tier in ("full", "fp16", "int8")]
    for tier in networks[:-1]:
        deformer = load(tier)
        if math.isinf(budget_ms) or deformer.milliseconds() <= budget_ms:
            return tier, deformer
    tier = networks[-1] if networks else held[0]
    return tier, load(tier)


def moving_subject(bundle: Bundle, tier: str) -> Subject:
    """The head that a tier poses: for `linear` the deformation is part of its expressions."""
    subject = bundle.subject
    if tier != "linear":
        return subject
    return replace(subject, expression_basis=subject.expression_basis + bundle.deform_linear)
