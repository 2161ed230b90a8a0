"""The rig that explains the landmarks: identity, focal length, and per frame expression, head pose and gaze.

All frames are solved together by L-BFGS through the rig's torch form, in stages: pose, identity, everything.
Image quantities are measured in units of the face's size, so that the same weights serve any resolution.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from cap4d.rig.head import HeadRig
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.track.landmark_sets import CHIN, FEATURES, GAPS, OVAL, RIGID
from cap4d.track.landmarks import IRIS, N_LANDMARKS
from cap4d.track.progress import progress

log = logging.getLogger(__name__)

FACE_SIZE = 300.0  # residuals are measured in px of a face this wide
FOCAL_PRIOR = (
    1.3  # of the image's larger side: a phone at arm's length; photos leave focal and distance ambiguous
)
FOCAL_SPREAD = 0.2  # standard deviation of its logarithm
STRIDE = 25  # iterations between looks at the progress
ENOUGH = 5e-4  # share of the energy that as many iterations must win for the search to go on
TRANSLATION_UNIT = 0.1  # m; brings the optimiser's variables to one scale


@dataclass(frozen=True, eq=False)
class Observations:
    """Landmarks of T frames.

    Args:
        points: float64[T, 478, 2] px; anything where not valid.
        valid: bool[T] a face was found.
        sizes: int[T, 2] width and height of each image, px.
        camera_of: int[T] which camera (focal length) took the frame, 0..C-1.
        continuous: The frames follow each other in time.
        known: bool[478] the rig has a point for the landmark; None: all.
    """

    points: np.ndarray
    valid: np.ndarray
    sizes: np.ndarray
    camera_of: np.ndarray
    continuous: bool
    known: np.ndarray | None = None

    @property
    def face_sizes(self) -> np.ndarray:
        """[T] px: the square root of the area of the landmarks' bounding box."""
        extent = self.points[:, : IRIS["right"]].max(1) - self.points[:, : IRIS["right"]].min(1)
        sizes = np.sqrt(np.maximum(extent.prod(1), 1))
        return np.where(self.valid, sizes, np.median(sizes[self.valid]))


@dataclass(frozen=True, eq=False)
class Solution:
    """Rig parameters of T frames (as in `Capture`), and the focal lengths of C cameras in px; float64."""

    shape: np.ndarray
    expr: np.ndarray
    rot: np.ndarray
    tra: np.ndarray
    eye_rot: np.ndarray
    focal: np.ndarray


@dataclass(frozen=True)
class Weights:
    """What the solver believes, as weights on squares of standard-deviation-like units.

    Args:
        feature, plain, outline, chin, iris: Of landmarks.
        gap: Of the opening of lids and lips.
        outlier: px (of a 300 px face) beyond which residuals count linearly.
        shape: Of identity coefficients, per frame.
        expr: Of expression coefficients; `sparse`: of their absolute values.
        range: Of leaving the rig's expression range.
        gaze: Of eye rotation, per rad^2; `roll`: about the line of sight, which the image hardly shows.
        pose_jerk: Of second differences of rotation (rad) and translation (in 0.1 m).
        expr_jerk: Of absolute second differences of expressions: a blink costs what it moves, no more.
        gaze_jerk: The same for eye rotation: saccades.
    """

    feature: float = 0.5
    plain: float = 0.15
    outline: float = 0.02
    chin: float = 0.3
    iris: float = 2.0
    gap: float = 1.0
    outlier: float = 3.0
    shape: float = 0.2
    expr: float = 1.0
    sparse: float = 60.0
    range: float = 10000.0
    gaze: float = 5.0
    roll: float = 1000.0
    pose_jerk: float = 3e4
    expr_jerk: float = 20.0
    gaze_jerk: float = 20.0


def solve(rig: HeadRig, observations: Observations, *, weights: Weights | None = None) -> Solution:
    """Fits the rig to the landmarks.

    Args:
        rig: A rig of the 478 landmark points (`HeadRig.resample` at a `Correspondence`).
        observations: At least one valid frame.
        weights: The balance of evidence and belief.
    """
    problem = Problem(rig, observations, weights or Weights())
    x = problem.start()
    problem.minimise(x, ("rot", "tra"), iterations=80, only=RIGID)
    problem.minimise(x, ("rot", "tra", "shape", "focal"), iterations=120)
    problem.minimise(x, ("rot", "tra", "shape", "focal", "expr", "eye_rot"), iterations=500)
    return problem.solution(x)


def landmark_weights(weights: Weights, known: np.ndarray | None = None) -> np.ndarray:
    """float64[478]"""
    w = np.full(N_LANDMARKS, weights.plain)
    w[list(FEATURES)] = weights.feature
    w[list(OVAL)] = weights.outline
    w[list(CHIN)] = weights.chin
    w[IRIS["right"] :] = 0
    w[list(IRIS.values())] = weights.iris
    return w if known is None else w * known


def project(points: torch.Tensor, rot: torch.Tensor, tra: torch.Tensor, focal: torch.Tensor) -> torch.Tensor:
    """Head points [T, P, 3], rig axes -> [T, P, 2] px from the principal point; focal [T] px (fact 10)."""
    world = points @ axis_angle_to_rotmat(rot).swapaxes(-1, -2) + tra[:, None]
    depth = (-world[..., 2:]).clamp_min(1e-3)
    return focal[:, None, None] * torch.cat([world[..., :1], -world[..., 1:2]], -1) / depth


def reprojection_errors(rig: HeadRig, observations: Observations, solution: Solution) -> np.ndarray:
    """[T, 478] px at an image of 512 px: the rig's points' distance from the landmarks; NaN where not valid.

    Only the iris centres of the iris points are on the rig; the rest of them are NaN.
    """
    problem = Problem(rig, observations, Weights())
    with torch.no_grad():
        x = problem.variables(solution)
        distance = (problem.predicted(x) - problem.points).norm(dim=-1).numpy()
    errors = distance * (512 / observations.sizes.max(1))[:, None]
    errors[~observations.valid] = np.nan
    errors[:, landmark_weights(Weights(), observations.known) == 0] = np.nan
    return errors


class Problem:
    """The energy and its variables, tensors named as in `Solution` (tra and focal in units of their own)."""

    def __init__(self, rig: HeadRig, observations: Observations, weights: Weights) -> None:
        self.rig = rig.map(lambda array: torch.as_tensor(np.asarray(array), dtype=torch.float64))
        self.observations, self.weights = observations, weights
        centre = observations.sizes[:, None] / 2
        points = np.where(observations.valid[:, None, None], observations.points - centre, 0)
        self.points = torch.as_tensor(points)
        self.camera_of = torch.as_tensor(observations.camera_of)
        self.unit = torch.as_tensor(FACE_SIZE / observations.face_sizes * observations.valid)[:, None, None]
        self.frames = len(points)
        self.more_evidence: Callable[[dict[str, torch.Tensor]], torch.Tensor] | None = None
        self.range = torch.as_tensor(np.asarray(rig.expression_range, np.float64))
        first = [
            np.flatnonzero(observations.camera_of == c)[0] for c in range(observations.camera_of.max() + 1)
        ]
        self.prior_focal = torch.as_tensor(FOCAL_PRIOR * observations.sizes[first].max(1).astype(np.float64))

    def start(self) -> dict[str, torch.Tensor]:
        """The neutral head, upright, as far away as the face is small."""
        zeros = {name: torch.zeros(self.frames, 3, dtype=torch.float64) for name in ("rot", "tra", "eye_rot")}
        template = self.rig.template[: IRIS["right"]]
        extent = template.amax(0) - template.amin(0)
        size = torch.as_tensor(self.observations.face_sizes)
        depth = self.prior_focal[self.camera_of] * (extent[0] * extent[1]).sqrt() / size
        image = torch.as_tensor(_filled(self.points.numpy().mean(1), self.observations.valid))
        sideways = image * (depth / self.prior_focal[self.camera_of])[:, None] * torch.tensor([1.0, -1.0])
        zeros["tra"] = (torch.cat([sideways, -depth[:, None]], 1) - template.mean(0)) / TRANSLATION_UNIT
        return zeros | {
            "shape": torch.zeros(self.rig.n_identity, dtype=torch.float64),
            "expr": torch.zeros(self.frames, self.rig.n_expressions, dtype=torch.float64),
            "focal": torch.zeros(len(self.prior_focal), dtype=torch.float64),
        }

    def variables(self, solution: Solution) -> dict[str, torch.Tensor]:
        x = {name: torch.tensor(getattr(solution, name)) for name in ("shape", "expr", "rot", "eye_rot")}
        focal = torch.as_tensor(solution.focal)
        return x | {
            "tra": torch.as_tensor(solution.tra) / TRANSLATION_UNIT,
            "focal": (focal / self.prior_focal).log(),
        }

    def solution(self, x: dict[str, torch.Tensor]) -> Solution:
        y = {name: value.detach().numpy() for name, value in x.items()}
        focal = (self.prior_focal * x["focal"].detach().exp()).numpy()
        return Solution(y["shape"], y["expr"], y["rot"], y["tra"] * TRANSLATION_UNIT, y["eye_rot"], focal)

    def predicted(self, x: dict[str, torch.Tensor]) -> torch.Tensor:
        """[T, 478, 2] px from the principal point."""
        head = self.rig.subject(x["shape"]).pose(x["expr"], eye_rot=x["eye_rot"])
        focal = (self.prior_focal * x["focal"].exp())[self.camera_of]
        return project(head, x["rot"], x["tra"] * TRANSLATION_UNIT, focal)

    def minimise(
        self,
        x: dict[str, torch.Tensor],
        free: tuple[str, ...],
        *,
        iterations: int,
        only: tuple[int, ...] | None = None,
    ) -> None:
        """L-BFGS over the named variables, in place."""
        weight = torch.as_tensor(landmark_weights(self.weights, self.observations.known))
        if only is not None:
            weight = (weight > 0) * torch.zeros_like(weight).index_fill(0, torch.tensor(only), 1.0)
        for name in x:
            x[name] = x[name].detach().requires_grad_(name in free)
        variables = [x[name] for name in free]
        optimiser = torch.optim.LBFGS(
            variables, max_iter=STRIDE, history_size=30, line_search_fn="strong_wolfe", tolerance_change=1e-9
        )

        def closure() -> torch.Tensor:
            optimiser.zero_grad()
            energy = self.evidence(x, weight) + self.belief(x)
            if self.more_evidence is not None:
                energy = energy + self.more_evidence(x)
            energy.backward()
            return energy

        energies = [float(optimiser.step(closure).detach())]
        looks = range(STRIDE, iterations, STRIDE)
        for _ in progress(looks, "solving for " + ", ".join(free), len(looks)):
            energies.append(float(optimiser.step(closure).detach()))  # that before the step
            if energies[-2] - energies[-1] < ENOUGH * energies[-1]:
                break
        log.debug("%s: energy %s", ", ".join(free), " ".join(f"{energy:.0f}" for energy in energies))

    def evidence(self, x: dict[str, torch.Tensor], weight: torch.Tensor) -> torch.Tensor:
        """Robust squares of the residuals and of the errors of the gaps between lids and lips."""
        residual = (self.predicted(x) - self.points) * self.unit
        upper, lower = torch.tensor(GAPS).T
        gap = residual[:, upper] - residual[:, lower]
        points = weight[:, None].sqrt() * residual
        return _robust(points, self.weights.outlier) + self.weights.gap * _robust(gap, self.weights.outlier)

    def belief(self, x: dict[str, torch.Tensor]) -> torch.Tensor:
        """What identities, expressions, focal lengths and motions are like."""
        w, expr = self.weights, x["expr"]
        outside = (expr - self.range[:, 1]).relu() + (self.range[:, 0] - expr).relu()
        energy = self.frames * w.shape * x["shape"].square().sum()
        energy = energy + self.frames * (x["focal"] / FOCAL_SPREAD).square().sum()
        energy = energy + w.expr * expr.square().sum() + w.range * outside.square().sum()
        energy = energy + w.sparse * _absolute(expr, 0.02)
        gaze = x["eye_rot"]
        energy = energy + w.gaze * gaze.square().sum() + w.roll * gaze[:, 2].square().sum()
        if self.observations.continuous and self.frames > 2:
            pose = torch.cat([x["rot"], x["tra"]], 1)
            energy = energy + w.pose_jerk * _jerk(pose).square().sum()
            energy = energy + w.expr_jerk * _absolute(_jerk(expr), 0.02)
            energy = energy + w.gaze_jerk * _absolute(_jerk(gaze), 0.01)
        return energy


def _robust(residual: torch.Tensor, outlier: float) -> torch.Tensor:
    """Sum of pseudo-Huber losses of vectors [..., 2]: |r|^2 while small, 2 outlier |r| when large."""
    return (2 * outlier**2 * ((1 + residual.square().sum(-1) / outlier**2).sqrt() - 1)).sum()


def _absolute(x: torch.Tensor, width: float) -> torch.Tensor:
    """Sum of |x|, rounded off within `width` of zero."""
    return ((x.square() + width**2).sqrt() - width).sum()


def _jerk(x: torch.Tensor) -> torch.Tensor:
    """Second differences over time of [T, C]."""
    return x[2:] - 2 * x[1:-1] + x[:-2]


def _filled(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[T, C] with rows that are not valid interpolated from those that are."""
    frames, known = np.arange(len(values)), np.flatnonzero(valid)
    return np.stack([np.interp(frames, known, column[known]) for column in values.T], 1)


def interpolate_invalid(solution: Solution, valid: np.ndarray) -> Solution:
    """Per-frame parameters of frames without a face, from their neighbours in time."""
    names = ("expr", "rot", "tra", "eye_rot")
    return replace(solution, **{name: _filled(getattr(solution, name), valid) for name in names})
