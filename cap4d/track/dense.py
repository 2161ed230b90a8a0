"""Finer than landmarks: every frame must agree with every other about the colour of each point of the skin.

Thousands of surface points are followed through the video; pose, expression and gaze are refined until each
point looks the same in all frames (group-wise registration: the variance over frames is minimised, so there
is no reference frame to drift from). Landmarks, priors and temporal smoothness of solve.py stay on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from cap4d.camera import Camera, head_fixed, opencv_from_rig
from cap4d.mesh import rasterize_mesh
from cap4d.rig.head import HeadRig
from cap4d.track.correspondence import skin_and_eyes
from cap4d.track.solve import (
    FACE_SIZE,
    OVAL,
    TRANSLATION_UNIT,
    Observations,
    Problem,
    Solution,
    Weights,
    project,
)

log = logging.getLogger(__name__)

ROUNDS = ((2.5, 25), (1.2, 25), (0.6, 30))
"""Blur of the images (standard deviation, px of a 300 px face) and iterations, from coarse to fine."""
CONTEXT = (
    12.0  # px of a 300 px face: lightness is measured against the mean this far around, so light may change
)
CONTRAST_FLOOR = 0.02  # of lightness; flat skin is not amplified beyond it
OUTLIER = 0.5  # of normalised lightness: wrinkles, highlights and hair count linearly beyond it
STRIDE = 3 / 300  # distance of the points, of the face's size
DENSE_WEIGHT = 4.0
PLAIN_SHARE = 0.2  # what the weights of landmarks on plain skin are multiplied by once the skin has its say
FEATURE_SHARE = (
    0.5  # the same for lids, lips, brows and nose: lips roll and lids fold, which skin points cannot follow
)
POSE_JERK = 1e6  # as in Weights; turns, shifts and expressions that look alike would trade noise otherwise
EXPR_JERK = 40.0
LIPS_OUTLINE = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)


@dataclass(frozen=True, eq=False)
class SkinPoints:
    """Q points of a rig's surface: vertices int64[Q, 3] and bary float64[Q, 3]."""

    vertices: np.ndarray
    bary: np.ndarray


def refine(
    rig: HeadRig,
    landmark_rig: HeadRig,
    observations: Observations,
    solution: Solution,
    image: Callable[[int], np.ndarray],
    *,
    weights: Weights | None = None,
) -> Solution:
    """Refines pose, expression and gaze of a video's frames.

    Args:
        rig: The whole rig.
        landmark_rig: The rig on the 478 landmark points.
        solution: Where to start: solve.py's.
        image: Frame number -> uint8[H, W, 3].
        weights: As for `solve`.
    """
    weights = weights or Weights()
    lighter = replace(
        weights,
        feature=FEATURE_SHARE * weights.feature,
        plain=PLAIN_SHARE * weights.plain,
        outline=PLAIN_SHARE * weights.outline,
        pose_jerk=POSE_JERK,
        expr_jerk=EXPR_JERK,
    )
    problem = Problem(landmark_rig, observations, lighter)
    points = choose_points(rig, observations, solution)
    skin = rig.resample(points.vertices, points.bary).map(
        lambda a: torch.as_tensor(np.asarray(a), dtype=torch.float32)
    )
    valid = np.flatnonzero(observations.valid)
    face = float(np.median(observations.face_sizes))
    scale = min(1.0, FACE_SIZE / face)
    unit = scale * face / FACE_SIZE  # px of the pictures per px of a 300 px face
    lightness = np.stack([_lightness(image(t), scale) for t in valid])
    x = problem.variables(solution)
    for blur, iterations in ROUNDS:
        pictures = torch.as_tensor(
            np.stack([normalised(picture, blur * unit, CONTEXT * unit) for picture in lightness])
        )[:, None]
        term = _SkinTerm(skin, pictures, problem, torch.as_tensor(valid), scale)
        before = term.spread(x)
        problem.more_evidence = term
        problem.minimise(x, ("rot", "tra", "expr", "eye_rot"), iterations=iterations)
        log.debug("blur %.1f px: spread over frames %.4f -> %.4f", blur, before, term.spread(x))
    return problem.solution(x)


def choose_points(rig: HeadRig, observations: Observations, solution: Solution) -> SkinPoints:
    """Points of the skin inside the face's outline, spread evenly over the frame nearest to the mean pose."""
    off = np.abs(solution.rot - solution.rot.mean(0)).sum(1) + np.abs(solution.expr).sum(1) * 0.02
    frame = int(np.argmin(np.where(observations.valid, off, np.inf)))
    vertices = rig.subject(np.float32(solution.shape)).pose(np.float32(solution.expr[frame]))
    width, height = observations.sizes[frame]
    focal = solution.focal[observations.camera_of[frame]]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(
        K, head_fixed(np.eye(4), solution.rot[frame], solution.tra[frame]), int(width), int(height)
    )
    size = 1 / (STRIDE * observations.face_sizes[frame])
    small = camera.resized(max(1, round(width * size)), max(1, round(height * size)))
    fragments = rasterize_mesh(opencv_from_rig(np.asarray(vertices, np.float64)), rig.faces, small)
    landmarks = observations.points[frame] * [small.width / width, small.height / height]
    inside = np.zeros(fragments.face.shape, np.uint8)
    cv2.fillPoly(inside, [np.round(landmarks[list(OVAL)]).astype(np.int32)], 1)
    cv2.fillPoly(inside, [np.round(landmarks[list(LIPS_OUTLINE)]).astype(np.int32)], 0)
    skin, _ = skin_and_eyes(rig)
    chosen = fragments.hit & (inside > 0) & skin[fragments.face]
    return SkinPoints(rig.faces[fragments.face[chosen]].astype(np.int64), fragments.bary[chosen])


class _SkinTerm:
    """Robust variance over frames of the normalised lightness of each skin point."""

    def __init__(
        self, skin: HeadRig, pictures: torch.Tensor, problem: Problem, valid: torch.Tensor, scale: float
    ) -> None:
        self.skin, self.pictures, self.problem, self.valid, self.scale = skin, pictures, problem, valid, scale
        sizes = torch.as_tensor(problem.observations.sizes[valid.numpy()], dtype=torch.float32)
        self.half = sizes[:, None] / 2

    def __call__(self, x: dict[str, torch.Tensor]) -> torch.Tensor:
        residual = self._residual(x)
        loss = 2 * OUTLIER**2 * ((1 + (residual / OUTLIER).square()).sqrt() - 1)
        return DENSE_WEIGHT * loss.sum().double()

    def spread(self, x: dict[str, torch.Tensor]) -> float:
        """Root mean square deviation of a point's lightness from its mean."""
        with torch.no_grad():
            return float(self._residual(x).square().mean().sqrt())

    def _residual(self, x: dict[str, torch.Tensor]) -> torch.Tensor:
        """[T, Q] lightness minus its mean over frames."""
        y = {name: value.float() for name, value in x.items()}
        expr, rot, tra = (y[name][self.valid] for name in ("expr", "rot", "tra"))
        focal = (self.problem.prior_focal * x["focal"].exp())[self.problem.camera_of][self.valid].float()
        head = self.skin.subject(y["shape"]).pose(expr)  # the skin does not turn with the eyes
        place = project(head, rot, tra * TRANSLATION_UNIT, focal) / self.half  # -1..1 over the image
        seen = torch.nn.functional.grid_sample(
            self.pictures, place[:, None], mode="bilinear", padding_mode="border", align_corners=False
        )[:, 0, 0]
        return seen - seen.mean(0)


def normalised(lightness: np.ndarray, blur: float, context: float) -> np.ndarray:
    """float32[H, W]: lightness, blurred, relative to the mean and the contrast within `context` px."""
    smooth = cv2.GaussianBlur(lightness, (0, 0), blur)
    mean = cv2.GaussianBlur(smooth, (0, 0), context)
    difference = smooth - mean
    contrast = cv2.GaussianBlur(difference * difference, (0, 0), context)
    return difference / np.sqrt(contrast + CONTRAST_FLOOR**2)


def _lightness(image: np.ndarray, scale: float) -> np.ndarray:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return grey if size == image.shape[1::-1] else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
