"""A made-up person's true motion: what the rig's parameters say, and what a rig cannot say.

Real faces do not move as a linear model does. Here every expression moves this person's skin a little more or
less than the rig has it, differently on the left and right, and expressions that meet push the skin further.
At rest there is no difference, and a capture keeps the rig's own parameters, as a tracker would find them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cap4d.rig.head import HeadRig, Subject
from cap4d.synth.atlas import KINDS, kinds_of_vertices
from cap4d.synth.face_paint import eye_balls, noise

OWN_SHARE = 0.18  # of an expression's motion: how far the person's own differs
PAIR_SHARE = 0.30  # of the geometric mean of two motions: how far the skin goes where both are at work
N_PAIRS = 48
FIELD = 0.045  # m; the person's ways vary over that much skin
SEVERAL = 4  # different fields that expressions choose from
LID_ROOM = 0.004  # m about the eyeballs where lids keep the rig's motion, or they would cut into the eyes


@dataclass(frozen=True, eq=False)
class Body:
    """A subject whose expression space is followed by products of pairs of expressions.

    Args:
        subject: With E + K expressions.
        pairs: int[K, 2] which expressions' product drives each of the last K.
    """

    subject: Subject
    pairs: np.ndarray

    def pose(self, expr: np.ndarray, *, eye_rot: np.ndarray, neck_rot: np.ndarray) -> np.ndarray:
        """[V, 3] m, rig axes, as `Subject.pose`, for the rig's own `expr` [E]."""
        products = expr[self.pairs[:, 0]] * expr[self.pairs[:, 1]]
        full = np.concatenate([expr, products]).astype(np.float32)
        return self.subject.pose(full, eye_rot=eye_rot, neck_rot=neck_rot)


def draw_body(rig: HeadRig, subject: Subject, rng: np.random.Generator, amount: float) -> Body:
    """A person's own way to move; `amount` 0 moves exactly as the rig does."""
    fields = _fields(rig, rng)
    basis = subject.expression_basis
    chosen = fields[rng.integers(SEVERAL, size=len(basis))]
    own = basis * (1 + amount * OWN_SHARE * chosen[..., None])
    pairs = _pairs(rig, rng)
    lengths = np.linalg.norm(basis, axis=2)
    shared = np.sqrt(lengths[pairs[:, 0]] * lengths[pairs[:, 1]])
    push = np.stack([fields[rng.integers(SEVERAL, size=len(pairs))] for _ in range(3)], -1)
    span = np.maximum(np.abs(rig.expression_range).max(1), 1e-6)
    scale = 1 / np.sqrt(span[pairs[:, 0]] * span[pairs[:, 1]])
    extra = amount * PAIR_SHARE * scale[:, None, None] * shared[..., None] * push
    return Body(_extended(subject, own, extra), pairs)


def _fields(rig: HeadRig, rng: np.random.Generator) -> np.ndarray:
    """float32[SEVERAL, V] smooth, in about [-1, 1]; nothing on what is rigid, and at the lids."""
    skin = np.isin(kinds_of_vertices(rig), [KINDS.index("skin"), KINDS.index("cavity")])
    for centre, radius in eye_balls(rig):
        off = np.linalg.norm(rig.template - centre, axis=1) - radius
        skin = skin * np.clip(off / LID_ROOM - 0.5, 0, 1)
    seeds = rng.integers(2**31, size=SEVERAL)
    return np.stack([1.5 * noise(rig.template, FIELD, int(seed), 2) * skin for seed in seeds]).astype(
        np.float32
    )


def _pairs(rig: HeadRig, rng: np.random.Generator) -> np.ndarray:
    """int[N_PAIRS, 2] expressions that move the same skin; some are paired with themselves."""
    lengths = np.linalg.norm(rig.expression_basis, axis=2).astype(np.float64)
    overlap = np.sqrt(lengths) @ np.sqrt(lengths).T
    upper = np.triu(overlap)
    return np.argwhere(upper > 0)[_draw(rng, upper[upper > 0])]


def _draw(rng: np.random.Generator, weights: np.ndarray) -> np.ndarray:
    count = min(N_PAIRS, len(weights))
    return np.sort(rng.choice(len(weights), count, replace=False, p=weights / weights.sum()))


def _extended(subject: Subject, own: np.ndarray, extra: np.ndarray) -> Subject:
    """The subject with its own expression basis, followed by `extra` [K, V, 3] that moves no joint."""
    k = len(extra)
    names = tuple(f"{i}" for i in range(k))
    turns = subject.expr_rotation
    return replace(
        subject,
        expression_names=subject.expression_names + names,
        expression_basis=np.concatenate([own, extra]).astype(np.float32),
        joints_expression=np.pad(subject.joints_expression, ((0, k), (0, 0), (0, 0))),
        expr_rotation=None if turns is None else np.pad(turns, ((0, k), (0, 0))),
    )
