"""Which point of a rig each face landmark is, for any rig: look at renders as at photos, and project back.

The rig's neutral head is drawn from a few sides, once with closed lips and once with open ones (closed lips
cannot tell the upper from the lower). A landmark found in a picture is the surface point its pixel shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cap4d.camera import Camera, opencv_from_rig, orbit_camera
from cap4d.errors import DataError
from cap4d.mesh import rasterize_mesh, shade, vertex_normals
from cap4d.rig.head import HeadRig
from cap4d.track.landmarks import IRIS, N_LANDMARKS, Detector

SIZE = 512  # px of the renders
VIEWS = ((0.0, 0.0), (0.0, 12.0), (0.0, -12.0), (-22.0, 0.0), (22.0, 0.0))  # yaw, pitch in degrees
SEARCH = 14  # px around a landmark in which its surface may begin (a lid just above the eyeball)
AGREEMENT = 0.008  # m; views that disagree more with the median place are left out
OUTER_LIPS = (0, 17)  # landmarks above and below the mouth
MOUTH_OPENING = 0.012  # m between them beyond the neutral, for the renders with open lips
IRIS_ANGLE_DEG = 27.0  # of a painted iris as seen from the eyeball's centre

LIPS = frozenset(
    [61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185]
    + [78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191]
    + [76, 77, 90, 180, 85, 16, 315, 404, 320, 307, 306, 408, 304, 303, 302, 11, 72, 73, 74, 184]
    + [62, 96, 89, 179, 86, 15, 316, 403, 319, 325, 292, 407, 272, 271, 268, 12, 38, 41, 42, 183]
)
"""The four rings of MediaPipe's face mesh around the mouth, outermost to innermost."""


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Surface points of a rig; P = 478.

    Args:
        vertices: int64[P, 3] vertices of the triangle each landmark lies on.
        bary: float64[P, 3] its place there.
        known: bool[P] False where no view showed the landmark on the rig.
    """

    vertices: np.ndarray
    bary: np.ndarray
    known: np.ndarray

    def points(self, vertices: np.ndarray) -> np.ndarray:
        """[..., V, 3] -> [..., P, 3]"""
        return (vertices[..., self.vertices, :] * self.bary[..., None]).sum(-2)


def find_correspondence(rig: HeadRig) -> Correspondence:
    """Landmarks on the surface of `rig`.

    Raises:
        DataError: MediaPipe sees no face in the rig's renders.
    """
    subject = rig.subject()
    with Detector(video=False) as detector:
        closed = _agree(rig, _sightings(rig, detector, subject.neutral))
        opened = opening_expression(rig, closed)
        if opened is None:
            return closed
        lips = _agree(rig, _sightings(rig, detector, subject.pose(opened)))
    chosen = np.isin(np.arange(N_LANDMARKS), list(LIPS)) & lips.known
    return Correspondence(
        np.where(chosen[:, None], lips.vertices, closed.vertices),
        np.where(chosen[:, None], lips.bary, closed.bary),
        closed.known | chosen,
    )


def opening_expression(rig: HeadRig, lips: Correspondence) -> np.ndarray | None:
    """float32[E]: the one expression, as far as it goes, that parts the lips most; None if none does."""
    motion = lips.points(np.asarray(rig.expression_basis))[:, list(OUTER_LIPS), 1]  # [E, 2] m upwards
    parting = motion[:, 0] - motion[:, 1]
    reach = np.where(parting > 0, rig.expression_range[:, 1], rig.expression_range[:, 0])
    best = int(np.argmax(parting * reach))
    if parting[best] * reach[best] < MOUTH_OPENING / 2:
        return None
    expr = np.zeros(rig.n_expressions, np.float32)
    expr[best] = np.sign(parting[best]) * min(abs(reach[best]), MOUTH_OPENING / abs(parting[best]))
    return expr


@dataclass(frozen=True, eq=False)
class _Sighting:
    """One view: for each landmark the triangle it lies on (-1: none), where, and how squarely it is seen."""

    face: np.ndarray
    bary: np.ndarray
    facing: np.ndarray


def _sightings(rig: HeadRig, detector: Detector, vertices: np.ndarray) -> list[_Sighting]:
    world = opencv_from_rig(np.asarray(vertices, np.float64))
    normals = vertex_normals(world, rig.faces)
    colors = rig.colors if rig.colors is not None else painted_eyes(rig)
    seen = []
    for yaw, pitch in VIEWS:
        camera = _portrait(rig, world, yaw, pitch)
        rgba = shade(world, rig.faces, camera, colors=colors, supersample=1)
        picture = np.uint8(255 * (rgba[..., :3] * rgba[..., 3:] + 0.55 * (1 - rgba[..., 3:])))
        landmarks = detector.landmarks(picture)
        if landmarks is not None:
            seen.append(_project_back(rig, world, normals, camera, landmarks))
    if not seen:
        raise DataError(rig.name, "head", expected="a rig whose render shows a face", found="no face")
    return seen


def _portrait(rig: HeadRig, world: np.ndarray, yaw: float, pitch: float) -> Camera:
    """A camera on the middle of the front of the head; the neck and what is below may leave the picture."""
    head = world[rig.regions["head"]] if "head" in rig.regions else world
    low, high = head.min(0), head.max(0)
    target = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2] + 0.05])
    extent = 1.15 * (high[1] - low[1])
    fov = 2 * np.degrees(np.arctan(extent / 2 / 1.0))
    return orbit_camera(
        yaw_deg=yaw, pitch_deg=pitch, distance=1.0, target=target, fov_y_deg=fov, width=SIZE, height=SIZE
    )


def painted_eyes(rig: HeadRig) -> np.ndarray:
    """[V, 3] plain colours for a rig without any: MediaPipe looks for irises, so the eyeballs get some."""
    colors = np.tile([0.78, 0.62, 0.55], (len(rig.template), 1))
    for j, driver in enumerate(rig.joint_drivers):
        if driver == "eyes":
            ball = np.flatnonzero(rig.skin_weights[:, j] > 0.5)
            gaze = rig.template[ball] - rig.joints[j]
            dark = gaze[:, 2] > np.cos(np.radians(IRIS_ANGLE_DEG)) * np.linalg.norm(gaze, axis=1)
            colors[ball] = np.where(dark[:, None], 0.12, 0.95)
    return colors


def _project_back(
    rig: HeadRig, world: np.ndarray, normals: np.ndarray, camera: Camera, landmarks: np.ndarray
) -> _Sighting:
    """Each landmark's nearest pixel that shows a surface it may lie on: eyeballs for irises, else skin."""
    fragments = rasterize_mesh(world, rig.faces, camera)
    on_skin, on_eye = skin_and_eyes(rig)
    face = np.full(N_LANDMARKS, -1)
    bary = np.zeros((N_LANDMARKS, 3))
    facing = np.zeros(N_LANDMARKS)
    for allowed, chosen in (
        (on_skin, np.arange(IRIS["right"])),
        (on_eye, np.arange(IRIS["right"], N_LANDMARKS)),
    ):
        shown = fragments.hit & allowed[fragments.face]
        rows, columns, distance = _nearest_pixels(shown, landmarks[chosen])
        near = distance < SEARCH
        face[chosen[near]] = fragments.face[rows, columns][near]
        bary[chosen[near]] = fragments.bary[rows, columns][near]
    hit = face >= 0
    corners = rig.faces[face[hit]]
    point = (world[corners] * bary[hit, :, None]).sum(1)
    normal = (normals[corners] * bary[hit, :, None]).sum(1)
    away = camera.position - point
    cosine = (normal * away).sum(1) / np.maximum(
        np.linalg.norm(normal, axis=1) * np.linalg.norm(away, axis=1), 1e-12
    )
    facing[hit] = np.clip(cosine, 0.02, 1)
    return _Sighting(face, bary, facing)


def skin_and_eyes(rig: HeadRig) -> tuple[np.ndarray, np.ndarray]:
    """bool[F] skin (neither eyeballs nor anything inside the mouth), and bool[F] eyeballs."""
    eyes = [j for j, driver in enumerate(rig.joint_drivers) if driver == "eyes"]
    eye = rig.skin_weights[:, eyes].sum(1) > 0.5
    inside = np.zeros(len(eye), bool)
    for name in ("teeth", "mouth", "eyes", "tongue"):
        inside[rig.regions.get(name, np.zeros(0, int))] = True
    if rig.mouth is not None:
        inside |= rig.mouth.local[:, 3] > 0
    return ~(eye | inside)[rig.faces].any(1), eye[rig.faces].all(1)


def _nearest_pixels(shown: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and distances (px) of the shown pixels nearest to points [P, 2] (pixel centres at .5)."""
    if not shown.any():
        zeros = np.zeros(len(points), int)
        return zeros, zeros, np.full(len(points), np.inf)
    distance, labels = cv2.distanceTransformWithLabels(
        np.uint8(~shown), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros((labels.max() + 1, 2), int)
    place[labels[shown]] = np.argwhere(shown)
    height, width = shown.shape
    inside = (points >= 0).all(1) & (points < [width, height]).all(1)
    column, row = np.clip(points.astype(int), 0, [width - 1, height - 1]).T
    nearest = place[labels[row, column]]
    return nearest[:, 0], nearest[:, 1], np.where(inside, distance[row, column], np.inf)


def _agree(rig: HeadRig, sightings: list[_Sighting]) -> Correspondence:
    """The mean place over the views that agree, put on the triangle of the view nearest to it."""
    face = np.stack([s.face for s in sightings])  # [views, P]
    bary = np.stack([s.bary for s in sightings])
    weight = np.stack([s.facing for s in sightings]) * (face >= 0)
    corners = rig.template[rig.faces[np.maximum(face, 0)]].astype(np.float64)  # [views, P, 3, 3]
    place = (corners * bary[..., None]).sum(-2)
    gaps = np.linalg.norm(place[:, None] - place[None], axis=-1)
    medoid = np.argmin(np.where(weight > 0, (gaps * weight[None]).sum(1), np.inf), 0)
    columns = np.arange(face.shape[1])
    weight = weight**2 * (np.linalg.norm(place - place[medoid, columns], axis=-1) < AGREEMENT)
    known = weight.sum(0) > 0
    mean = (place * weight[..., None]).sum(0) / np.maximum(weight.sum(0), 1e-12)[:, None]
    nearest = np.argmin(np.where(weight > 0, np.linalg.norm(place - mean, axis=-1), np.inf), 0)
    triangle = corners[nearest, columns]
    vertices = rig.faces[np.maximum(face[nearest, columns], 0)].astype(np.int64)
    return Correspondence(vertices, _barycentric(mean, triangle), known)


def _barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """[P, 3] weights of the projection of points [P, 3] into triangles [P, 3, 3], kept inside them."""
    a, b, c = (triangles[:, i] for i in range(3))
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    area = np.maximum(uu * vv - uv * uv, 1e-24)
    second, third = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    weights = np.clip(np.stack([1 - second - third, second, third], 1), 0, None)
    return weights / weights.sum(1, keepdims=True)
