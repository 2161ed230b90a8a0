"""Expressions of an avatar's own: what its cheaper deformers are made from, and others to measure them on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.camera import opencv_from_rig
from cap4d.drive.clip import Clip

FRAMES, HELD_OUT_FRAMES = 128, 48  # of clips, at most
BLOCK_SECONDS = 1.0  # neighbours in time are alike: every fourth block is held out, not every fourth frame
HELD_OUT_BLOCK = 3  # of 4
JITTER = 0.05  # of an expression's range, standard deviation
ALIKE = 1e-3  # of the range: frames so close are the same frame


@dataclass(frozen=True, eq=False)
class Expressions:
    """n moments of a face: expr float32[n, E]; eye_rot, jaw_rot float32[n, 3] rad."""

    expr: np.ndarray
    eye_rot: np.ndarray
    jaw_rot: np.ndarray

    def __len__(self) -> int:
        return len(self.expr)

    def at(self, index: np.ndarray | slice) -> Expressions:
        """Some of them."""
        return Expressions(*(getattr(self, f.name)[index] for f in fields(self)))

    @staticmethod
    def joined(parts: Sequence[Expressions]) -> Expressions:
        """One after the other."""
        return Expressions(
            *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Expressions))
        )


@dataclass(frozen=True, eq=False)
class OwnExpressions:
    """Frames of clips, the same with every expression jittered, and single expressions of a face at rest."""

    frames: Expressions
    jittered: Expressions
    singles: Expressions

    def all(self) -> Expressions:
        return Expressions.joined([self.frames, self.jittered, self.singles])


def own_expressions(
    bundle: Bundle, clips: Sequence[Clip] = (), *, seed: int = 0
) -> tuple[OwnExpressions, OwnExpressions]:
    """What to fit to, and what to measure on: no frame is in both.

    Args:
        clips: Besides the idle clip, e.g. the capture's.
        seed: Of the jitter and the choice of single expressions to measure on.
    """
    rng, span = np.random.default_rng(seed), np.abs(np.diff(bundle.expression_range)[:, 0])
    frames, held = _split([bundle.idle, *clips], span)
    fit = OwnExpressions(frames, _jittered(frames, bundle, rng), _singles(bundle, np.array([0.5, 1.0])))
    singles = _singles(bundle, np.array([0.75]))
    some = rng.permutation(len(singles))[:HELD_OUT_FRAMES]
    return fit, OwnExpressions(held, _jittered(held, bundle, rng), singles.at(np.sort(some)))


def offset_maps(bundle: Bundle, expressions: Expressions) -> Iterator[np.ndarray]:
    """What the network is given for each of them: float32[3, S, S] m, OpenCV axes (fact 20)."""
    subject = bundle.subject.map(np.ascontiguousarray)
    still = subject.pose(np.zeros_like(expressions.expr[0]))
    for expr, eye_rot, jaw_rot in zip(
        expressions.expr, expressions.eye_rot, expressions.jaw_rot, strict=True
    ):
        neutral = subject.pose(np.zeros_like(expr), jaw_rot=jaw_rot) if jaw_rot.any() else still
        posed = subject.pose(expr, eye_rot=eye_rot, jaw_rot=jaw_rot if jaw_rot.any() else None)
        yield np.ascontiguousarray(bundle.grid.to_map(opencv_from_rig(posed - neutral)), np.float32)


def _split(clips: Sequence[Clip], span: np.ndarray) -> tuple[Expressions, Expressions]:
    """Frames to fit to and frames to hold out.

    The idle clip may repeat the capture's frames: whatever is like a held-out frame is not fitted to.
    """
    frames = Expressions.joined([Expressions(c.expr, c.eye_rot, c.jaw_rot) for c in clips])
    blocks = np.concatenate([np.arange(len(c)) // max(1, round(BLOCK_SECONDS * c.fps)) for c in clips])
    held = blocks % 4 == HELD_OUT_BLOCK
    if not held.any():  # less than three seconds
        held[3 * len(held) // 4 :] = True
    near = np.array([(np.abs(frames.expr[held] - e) <= ALIKE * span).all(1).any() for e in frames.expr])
    used = ~near
    if not used.any():  # a single picture
        used = held
    fit, rest = np.flatnonzero(used), np.flatnonzero(held)
    return frames.at(_evenly(fit, FRAMES)), frames.at(_evenly(rest, HELD_OUT_FRAMES))


def _evenly(index: np.ndarray, most: int) -> np.ndarray:
    return index[np.linspace(0, len(index) - 1, min(most, len(index))).round().astype(int)]


def _jittered(frames: Expressions, bundle: Bundle, rng: np.random.Generator) -> Expressions:
    """Every expression of every frame moved at random, within its range as far as the frame was."""
    low, high = bundle.expression_range.T
    noise = JITTER * (high - low) * rng.normal(size=frames.expr.shape)
    limits = np.minimum(low, frames.expr), np.maximum(high, frames.expr)
    return Expressions(
        np.clip(frames.expr + noise, *limits).astype(np.float32), frames.eye_rot, frames.jaw_rot
    )


def _singles(bundle: Bundle, shares: np.ndarray) -> Expressions:
    """Each expression alone, at these shares of each end of its range that is not 0."""
    ends = bundle.expression_range.T[:, None] * shares[None, :, None]  # [2, shares, E]
    expr = (ends[..., None, :] * np.eye(bundle.n_expressions)).reshape(-1, bundle.n_expressions)
    expr = expr[expr.any(1)].astype(np.float32)
    zeros = np.zeros((len(expr), 3), np.float32)
    return Expressions(expr, zeros, zeros)
