"""Where MediaPipe's landmarks lie on an avatar, for any rig: by looking at the avatar itself.

A bundle names no landmarks and carries no rig, only points of its grid. They are a mesh, and the Gaussians
give it colours: enough of a picture for what finds the correspondence of a whole rig.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.camera import opencv_from_rig
from cap4d.errors import ArgumentError, DataError
from cap4d.mesh import vertex_normals
from cap4d.rig.atlas import islands
from cap4d.rig.head import HeadRig, Subject

SH_0 = 0.28209479177387814  # the constant spherical harmonic
NEIGHBOURS = 9  # landmarks around one that say how deep it lies
BACKWARD = -0.1  # of a unit normal's z: no part of a face
MAX_STEP = 0.012  # m from their depth: more is a place behind the face
ON_FACE, ACROSS = 0.6, 0.25
"""Shares of an expression's largest motion on the head: what landmarks must have of it, and what must be
across the line of sight (a picture hardly shows a jaw that comes forward)."""


@dataclass(frozen=True, eq=False)
class LandmarkHead:
    """An avatar's head on its P = 478 landmarks.

    Args:
        subject: It stands on the landmarks; rig axes, m.
        known: bool[P] False where a landmark was not found.
        expression_range: float32[E, 2]; 0 to 0 for an expression that landmarks do not show.
        eyes: float32[2, 3] m, the centres of the right and the left eyeball, or None.
    """

    subject: Subject
    known: np.ndarray
    expression_range: np.ndarray
    eyes: np.ndarray | None


def find_landmark_head(bundle: Bundle) -> LandmarkHead:
    """Takes 1 to 2 s; needs MediaPipe and OpenCV.

    Raises:
        ArgumentError: MediaPipe is not installed, or it sees no face in the avatar.
    """
    from cap4d.track.correspondence import find_correspondence

    for colors in (gaussian_colors(bundle), None):  # painted like a rig, if its own colours show no face
        try:
            found = find_correspondence(grid_rig(bundle, colors))
        except DataError:
            continue
        subject = bundle.subject.resample(found.vertices, found.bary)
        known = found.known & ~_astray(subject.neutral, found.known)
        shown = _shown(bundle.subject, subject, known)
        limits = np.where(shown[:, None], bundle.expression_range, 0)
        return LandmarkHead(subject, known, limits, _eyes(bundle.subject))
    raise ArgumentError("webcam: expected an avatar with a face; MediaPipe sees none in this one's picture")


def grid_rig(bundle: Bundle, colors: np.ndarray | None) -> HeadRig:
    """The avatar's grid as a rig without identities: the mesh of its triangles, as it looks at rest."""
    subject = bundle.subject
    rest = subject.neutral + opencv_from_rig(bundle.deform_neutral)
    count, joints = len(rest), len(subject.joints)
    return HeadRig(
        name=subject.rig_name,
        licence=bundle.rig_licence,
        template=rest,
        faces=bundle.grid.faces,
        uvs=np.zeros((0, 2), np.float32),
        uv_faces=np.zeros((0, 3), np.int32),
        identity_basis=np.zeros((1, count, 3), np.float32),
        expression_basis=subject.expression_basis,
        expression_names=subject.expression_names,
        expression_range=bundle.expression_range,
        joint_names=subject.joint_drivers,
        joint_drivers=subject.joint_drivers,
        joints=subject.joints,
        joints_identity=np.zeros((1, joints, 3), np.float32),
        joints_expression=subject.joints_expression,
        skin_weights=subject.skin_weights,
        expr_rotation=subject.expr_rotation,
        pose_basis=subject.pose_basis,
        pose_offset=subject.pose_offset,
        colors=colors,
        regions={
            "head": np.flatnonzero(_of_head(subject)),
            "mouth": np.flatnonzero(_hidden(rest, bundle) & _of_head(subject)),
        },
    )


def gaussian_colors(bundle: Bundle) -> np.ndarray:
    """[G, 3] sRGB: the mean of the Gaussians bound to the triangles around, by opacity and size."""
    rgb = np.clip(0.5 + SH_0 * bundle.sh[:, 0].astype(np.float64), 0, 1)
    area = np.exp(np.sort(bundle.log_scales, 1)[:, 1:].sum(1, dtype=np.float64))
    weight = area / (1 + np.exp(-bundle.opacity_logits.astype(np.float64)))
    total = np.zeros((len(bundle.grid), 4))
    for corner in bundle.grid.faces[bundle.binding].T:
        for channel in range(3):
            total[:, channel] += np.bincount(corner, weight * rgb[:, channel], len(total))
        total[:, 3] += np.bincount(corner, weight, len(total))
    return np.where(total[:, 3:] > 0, total[:, :3] / np.maximum(total[:, 3:], 1e-30), 0.5)


def _of_head(subject: Subject) -> np.ndarray:
    """bool[G] what does not bend with the neck."""
    bends = [j for j, driver in enumerate(subject.joint_drivers) if driver == "neck"]
    return subject.skin_weights[:, bends].sum(1) < 0.5


def _hidden(rest: np.ndarray, bundle: Bundle) -> np.ndarray:
    """bool[G] what no landmark lies on: all but the tip of the nose and what hangs together with it (teeth,
    tongue, hair), and what looks backwards, as the back of the head seen through an open mouth.
    """
    piece = islands(bundle.grid.faces, len(rest))
    tip = np.argmax(np.where(_of_head(bundle.subject), rest[:, 2], -np.inf))
    return (piece != piece[tip]) | (vertex_normals(rest, bundle.grid.faces)[:, 2] < BACKWARD)


def _astray(points: np.ndarray, known: np.ndarray) -> np.ndarray:
    """bool[P] landmarks that lie much deeper or higher than those around them in the picture."""
    gaps = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=-1)
    gaps[:, ~known] = np.inf
    around = np.argsort(gaps, 1)[:, 1 : NEIGHBOURS + 1]
    return np.abs(points[:, 2] - np.median(points[around, 2], 1)) > MAX_STEP


def _shown(head: Subject, landmarks: Subject, known: np.ndarray) -> np.ndarray:
    """bool[E] expressions whose motion is on the landmarks (no tongue), and not all towards the camera.

    Gaze is found by the irises; ARKit's expressions of it move the lids, and would be taken for a blink.
    """
    rigid = _of_head(head) & (head.skin_weights.sum(1) < 0.5)
    most = np.linalg.norm(head.expression_basis[:, rigid], axis=-1).max(1)
    seen = landmarks.expression_basis[:, known]
    across = np.linalg.norm(seen[..., :2], axis=-1).max(1)
    of_gaze = np.array([name.startswith("eyeLook") for name in head.expression_names])
    return ~of_gaze & (np.linalg.norm(seen, axis=-1).max(1) > ON_FACE * most) & (across > ACROSS * most)


def _eyes(subject: Subject) -> np.ndarray | None:
    joints = [subject.joints[j] for j, driver in enumerate(subject.joint_drivers) if driver == "eyes"]
    if len(joints) != 2:
        return None
    return np.stack(sorted(joints, key=lambda joint: joint[0])).astype(np.float32)  # the right is at -x
