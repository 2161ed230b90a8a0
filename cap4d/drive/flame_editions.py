"""FLAME's editions: what an expression of one is in another, where that can be said without the models.

FLAME 2020 and FLAME 2023 have different expression bases, each learnt on its own data, and `flame2023_no_jaw`
has another again, in which the jaw opens by expression. Between two different bases only meshes can tell:
that takes both licensed models (pose one, solve on the other; `cap4d-view --drive vertices.npy` and packets
of `vertices` do just that). What is exact without them:

- the same edition, however many coefficients the sender has: those beyond the avatar's have the smallest
  motion and are dropped, those it lacks are zero;
- the released system's 65th coefficient is its blink, no component of FLAME's (fact 4): a sender with more
  than 65 (FLAME's own 100) has no blink, and its 65th is dropped.
"""

from __future__ import annotations

import numpy as np

from cap4d.drive.packet import Cause, Rejected
from cap4d.rig.flame import BLINK, N_EXPRESSIONS

SAME_BASIS = (
    frozenset({"flame2020", "generic_model"}),
    frozenset({"flame2023"}),
    frozenset({"flame2023_no_jaw"}),
)
"""Names of rigs that share an expression basis."""
FILE_EXPRESSIONS = 100  # in a FLAME model file, without a blink


def same_basis(a: str, b: str) -> bool:
    """Whether two rigs' expressions mean the same."""
    return a == b or any({a, b} <= names for names in SAME_BASIS)


def convert_expression(expr: np.ndarray, rig_name: str, target: str, names: tuple[str, ...]) -> np.ndarray:
    """Expressions of FLAME rig `rig_name` as those of the avatar's rig.

    Args:
        expr: float32[K].
        rig_name, target: The sender's rig and the avatar's.
        names: E names of the avatar's expressions.
    Returns:
        float32[E].
    Raises:
        Rejected: RIG, another basis: with what it takes. SHAPE, a length that this edition does not have.
    """
    if not same_basis(rig_name, target):
        raise Rejected(Cause.RIG, _refusal(rig_name, target))
    if len(expr) == len(names):
        return expr
    if not target.startswith("flame") or not 0 < len(expr) <= FILE_EXPRESSIONS:
        raise Rejected(Cause.SHAPE, f"expr: expected {len(names)} numbers, got {len(expr)}")
    components = len(names) - (names[-1] == "blink")
    if len(expr) == N_EXPRESSIONS:  # CAP4D's layout: what stands last is a blink
        expr = expr[:BLINK]
    converted = np.zeros(len(names), np.float32)
    shared = min(len(expr), components)
    converted[:shared] = expr[:shared]
    return converted


def _refusal(rig_name: str, target: str) -> str:
    if rig_name.startswith("flame") and target.startswith("flame"):
        return (
            f"expr: expected expressions of {target}, got {rig_name}, whose basis is another: send vertices, "
            "which are retargeted"
        )
    return f"expr: expected expressions of {target}, got {rig_name}"
