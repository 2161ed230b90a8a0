"""Distils the deformation network to lines: a displacement per unit of each expression, on the grid.

Ridge regression (Hoerl and Kennard 1970) from expressions to what the network answers, before skinning, so
that the result can be added to a head's expression basis and costs nothing per frame. It learns from frames,
jittered frames and single expressions alike: without the singles it is off by twice as much on them (0.106 mm
instead of 0.050 on a talking head) and no nearer on frames (0.047 and 0.046). How strongly to shrink is what
serves frames best that were left out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.camera import opencv_from_rig
from cap4d.export.expressions import Expressions, OwnExpressions, offset_maps
from cap4d.track.progress import progress

SHRINKAGES = tuple(10.0**k for k in range(-6, 1))  # of the sum of squares of each expression
FOLDS = 4
EVERY = 8  # vertices that speak for their neighbours while the shrinkage is chosen
SINGULAR = 1e-6  # added to the squares of a skinning transform before it is inverted

Network = Callable[[np.ndarray], np.ndarray]
"""Offsets float32[3, S, S] m -> deformation, the same: `player.deformer.Deformer`, say."""


def distill(bundle: Bundle, network: Network, own: OwnExpressions) -> np.ndarray:
    """float32[E, G, 3] m per unit of expression, rig axes: `Bundle.deform_linear`.

    `subject.pose` with it added to `expression_basis`, plus `deform_neutral`, is as near to what the network
    gives as lines through the neutral face are: joints turn what is added before them, so what is learned is
    the network's answer turned back by the skinning transform of its moment.

    Args:
        network: Of the bundle's grid.
        own: What to learn from; see `own_expressions`.
    """
    kinds = (own.frames, own.jittered, own.singles)
    ends = np.cumsum([len(kind) for kind in kinds])[:-1]
    found = np.split(unskinned_answers(bundle, network, own.all()), ends)
    lines = _chosen([(kind.expr, answer) for kind, answer in zip(kinds, found, strict=True)])
    linear = np.zeros((bundle.n_expressions, len(bundle.grid), 3), np.float32)
    linear[:, bundle.grid.deformable] = lines.reshape(bundle.n_expressions, -1, 3)
    return linear


def answers(bundle: Bundle, network: Network, expressions: Expressions) -> np.ndarray:
    """float32[n, D, 3] m: what the network moves beyond its neutral answer, on the D deformable vertices."""
    deformable = bundle.grid.deformable
    still = bundle.deform_neutral[deformable]
    maps = progress(offset_maps(bundle, expressions), "linear deformer", len(expressions))
    return np.stack([bundle.grid.from_map(network(m))[deformable] - still for m in maps])


def unskinned_answers(bundle: Bundle, network: Network, expressions: Expressions) -> np.ndarray:
    """`answers` in rig axes, before the joints turn."""
    deformable, subject = bundle.grid.deformable, bundle.subject
    found = opencv_from_rig(answers(bundle, network, expressions))
    for i, expr in enumerate(expressions.expr):
        turns = {"eye_rot": expressions.eye_rot[i], "jaw_rot": expressions.jaw_rot[i]}
        found[i] = _solved(subject.skin_transform(expr, **turns)[deformable], found[i])
    return found


def _solved(transforms: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """x [D, 3] with transforms [D, 3, 3] x = moved; the nearest where a transform is all but singular."""
    transposed = transforms.swapaxes(-1, -2).astype(np.float64)
    squares = transposed @ transforms + SINGULAR * np.eye(3)
    return np.linalg.solve(squares, transposed @ moved[..., None])[..., 0]


def _chosen(kinds: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """[E, 3 D] the regression on all samples with the shrinkage that served left-out frames best.

    Args:
        kinds: ([n, E] expressions, [n, D, 3] answers) of frames, jittered frames and single expressions.
    """
    shrinkage = SHRINKAGES[int(np.argmin(_errors([(x, y[:, ::EVERY]) for x, y in kinds])))]
    return _ridge([_moments(x, y) for x, y in kinds], shrinkage)


def _errors(kinds: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """[len(SHRINKAGES)] squared errors on blocks of frames that were left out in turn, plain and jittered.

    What does not depend on the shrinkage is left out of them.
    """
    frames, errors = len(kinds[0][0]), np.zeros(len(SHRINKAGES))
    fold = np.arange(frames) * FOLDS // frames
    single = _moments(*kinds[2])
    for k in np.unique(fold) if frames >= FOLDS else ():
        seen = [_moments(x[fold != k], y[fold != k]) for x, y in kinds[:2]]
        left = [_moments(x[fold == k], y[fold == k]) for x, y in kinds[:2]]
        for i, shrinkage in enumerate(SHRINKAGES):
            lines = _ridge([*seen, single], shrinkage)
            errors[i] += sum(((xx @ lines - 2 * xy) * lines).sum() for xx, xy in left)
    return errors


def _moments(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X'X [E, E] and X'Y [E, 3 D], all that a regression needs of its samples; float64."""
    x = x.astype(np.float64)
    return x.T @ x, x.T @ y.reshape(len(y), -1)


def _ridge(moments: list[tuple[np.ndarray, np.ndarray]], shrinkage: float) -> np.ndarray:
    squares, products = (sum(m[i] for m in moments) for i in range(2))
    penalty = shrinkage * np.maximum(np.diag(squares), 1e-12)
    return np.linalg.solve(squares + np.diag(penalty), products)
