"""FLAME's editions: what an expression of one is in another.

FLAME 2020 and FLAME 2023 have different expression bases, each learnt on its own data, and `flame2023_no_jaw`
has another again, in which the jaw opens by expression. Without the sender's model this much is exact:

- the same edition, however many coefficients the sender has: those beyond the avatar's have the smallest
  motion and are dropped, those it lacks are zero;
- the released system's 65th coefficient is its blink, no component of FLAME's (fact 4): a sender with more
  than 65 (FLAME's own 100) has no blink, and its 65th is dropped.

Anything else takes the sender's rig file (the avatar carries its own basis): `EditionMap` poses the one and
solves on the other, or the sender does the first half and sends vertices.
"""

from __future__ import annotations

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.packet import Cause, Rejected
from cap4d.errors import ArgumentError
from cap4d.rig.flame import BLINK, N_EXPRESSIONS, N_VERTICES
from cap4d.rig.head import HeadRig

SAME_BASIS = (
    frozenset({"flame2020", "generic_model"}),
    frozenset({"flame2023"}),
    frozenset({"flame2023_no_jaw"}),
)
"""Names of rigs that share an expression basis."""
FILE_EXPRESSIONS = 100  # in a FLAME model file, without a blink
NOISE = 3e-5  # m per coordinate: motion below it is not worth an expression of 1 (the ridge)
OWN = 0.01  # share of a point's motion that eyes or the mouth's inside may have


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


class EditionMap:
    """Expressions and jaw of another FLAME -> the avatar's expressions, by what both do to the mesh (fact
    52).

    A jaw that the avatar has too stays a jaw; one that it lacks opens by expression. Neck and eyes are the
    same joints in every edition.

    Args:
        sender: The sender's rig.
        bundle: The avatar.
    Raises:
        ArgumentError: Not two FLAMEs.
    """

    def __init__(self, sender: HeadRig, bundle: Bundle) -> None:
        if not (sender.name.startswith("flame") and bundle.rig_name.startswith("flame")):
            raise ArgumentError(
                f"rig: expected two editions of FLAME, got {sender.name} and {bundle.rig_name}"
            )
        subject, grid = bundle.subject, bundle.grid
        inside = [j for j, driver in enumerate(subject.joint_drivers) if driver in ("eyes", "expr")]
        chosen = (grid.vertices < N_VERTICES).all(1) & (subject.skin_weights[:, inside].sum(1) < OWN)
        self.rig_name, self.n_expressions = sender.name, sender.n_expressions
        self.keeps_jaw = _has_jaw(sender.name) and _has_jaw(bundle.rig_name)
        points = sender.resample(grid.vertices[chosen], grid.bary[chosen]).subject()
        self._sender = points.map(np.ascontiguousarray)  # or every pose would copy the bases
        self._rest = self._sender.pose(np.zeros(self.n_expressions, np.float32))
        self._basis = np.ascontiguousarray(subject.expression_basis[:, chosen]).reshape(
            bundle.n_expressions, -1
        )
        basis = self._basis.astype(np.float64)
        ridge = NOISE**2 * np.eye(len(basis))
        self._expr_from_motion = np.linalg.solve(basis @ basis.T + ridge, basis).astype(np.float32)

    def __call__(self, expr: np.ndarray, jaw_rot: np.ndarray | None = None) -> tuple[np.ndarray, float]:
        """float32[E] of the avatar, and what it cannot show, mm root mean square over its points.

        Args:
            expr: float32[K] of the sender; K may be less than its rig's.
            jaw_rot: float32[3] rad.
        """
        padded = np.zeros(self.n_expressions, np.float32)
        padded[: len(expr)] = expr
        turn = None if jaw_rot is None or self.keeps_jaw else jaw_rot
        motion = (self._sender.pose(padded, jaw_rot=turn) - self._rest).reshape(-1)
        found = self._expr_from_motion @ motion
        left = motion - found @ self._basis
        return found, 1e3 * float(np.sqrt(3 * (left @ left) / len(left)))


def _has_jaw(rig_name: str) -> bool:
    return not rig_name.endswith("no_jaw")


def _refusal(rig_name: str, target: str) -> str:
    if rig_name.startswith("flame") and target.startswith("flame"):
        return (
            f"expr: expected expressions of {target}, got {rig_name}, whose basis is another: send vertices, "
            "which are retargeted"
        )
    return f"expr: expected expressions of {target}, got {rig_name}"
