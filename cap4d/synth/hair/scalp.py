"""Where hair grows on a head: measures of a neutral head, the hairline, and roots on its triangles.

Found from the eyes, the top of the skull and the ears alone, so that it holds for every rig. Rig axes, m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.mesh import vertex_normals
from cap4d.rig.head import HeadRig

INNER = ("eyes", "mouth", "teeth")  # regions that no hair touches
EYES_FLAME = np.array([0.0, 0.0233, 0.006]), 0.0315  # middle and half distance, of rigs that do not say
EAR_REACH = np.array([0.040, 0.026])  # m; half height and half depth of what counts as an ear

# The hairline: heights over the eyes (1 is the top of the skull) by the angle from the front, degrees.
HAIRLINE = np.array(
    [
        *([0, 0.72], [22, 0.72], [36, 0.66], [46, 0.52], [52, 0.36], [58, 0.22], [63, 0.00], [69, -0.16]),
        *([77, -0.18], [83, 0.02], [90, 0.16], [104, 0.10], [112, -0.20], [125, -0.40], [180, -0.52]),
    ]
)


@dataclass(frozen=True, eq=False)
class HeadMeasures:
    """A neutral head in numbers.

    Args:
        vertices: float64[V, 3] m.
        faces: int[F, 3].
        normals: [V, 3] unit, outwards.
        outer: bool[V]; False for eyes, mouth, teeth.
        ears: bool[V].
        eyes: [3] the middle between the eyes; half: half their distance; top: y of the skull's top, m.
        centre: [3] of the skull.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    outer: np.ndarray
    ears: np.ndarray
    eyes: np.ndarray
    half: float
    top: float
    centre: np.ndarray

    @property
    def unit(self) -> float:
        """From the eyes to the top of the skull, m."""
        return self.top - self.eyes[1]

    def height(self, points: np.ndarray) -> np.ndarray:
        """[...] of points [..., 3]: 0 at the eyes, 1 at the top of the skull."""
        return (points[..., 1] - self.eyes[1]) / self.unit

    def angle(self, points: np.ndarray) -> np.ndarray:
        """[...] degrees from the front about the skull's axis: 0 is the face, 90 an ear, 180 behind."""
        rel = points - self.centre
        return np.degrees(np.arctan2(np.abs(rel[..., 0]), rel[..., 2]))


def measure_head(rig: HeadRig, neutral: np.ndarray) -> HeadMeasures:
    """Measures of `neutral` [V, 3], a subject of `rig`."""
    vertices, faces = np.asarray(neutral, np.float64), np.asarray(rig.faces)
    outer = np.ones(len(vertices), bool)
    for name in INNER:
        outer[rig.regions.get(name, [])] = False
    eyes, half = _eyes(rig, vertices)
    head = np.zeros(len(vertices), bool)
    head[rig.regions["head"]] = True
    skull = vertices[head & outer]
    top = skull[:, 1].max()
    middle = skull[np.abs(skull[:, 1] - eyes[1] - 0.5 * (top - eyes[1])) < 0.25 * (top - eyes[1])]
    centre = np.array([0.0, eyes[1] + 0.1 * (top - eyes[1]), (middle[:, 2].min() + middle[:, 2].max()) / 2])
    ears = _ears(rig, vertices, head & outer, eyes)
    return HeadMeasures(
        vertices, faces, vertex_normals(vertices, faces), outer, ears, eyes, half, float(top), centre
    )


def _eyes(rig: HeadRig, vertices: np.ndarray) -> tuple[np.ndarray, float]:
    if len(rig.regions.get("eyes", ())) < 2:
        return EYES_FLAME
    points = vertices[rig.regions["eyes"]]
    left, right = points[points[:, 0] > 0], points[points[:, 0] <= 0]
    if not len(left) or not len(right):
        return EYES_FLAME
    return (left.mean(0) + right.mean(0)) / 2 * [0, 1, 1], float(left[:, 0].mean() - right[:, 0].mean()) / 2


def _ears(rig: HeadRig, vertices: np.ndarray, head: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    ears = np.zeros(len(vertices), bool)
    if "ears" in rig.regions:
        ears[rig.regions["ears"]] = True
        return ears
    near = head & (np.abs(vertices[:, 1] - eyes[1]) < 0.06)
    for side in (1, -1):
        tip = vertices[near][np.argmax(side * vertices[near, 0])]
        reach = ((vertices[:, 1:] - tip[1:] + [0.012, 0]) / EAR_REACH) ** 2
        ears |= head & (reach.sum(1) < 1) & (side * vertices[:, 0] > 0.86 * side * tip[0])
    return ears


def scalp_density(head: HeadMeasures, *, raised: float = 0.0, edge: float = 0.05) -> np.ndarray:
    """[V] share of the full density of hair: 1 on the scalp, 0 off it, `edge` (of a height) soft.

    Args:
        raised: Heights by which a receding hairline lies higher, most at the temples.
    """
    height, angle = head.height(head.vertices), head.angle(head.vertices)
    line = np.interp(angle, *HAIRLINE.T) + raised * np.exp(-(((angle - 35) / 25) ** 2))
    line = line + 0.4 * raised * np.exp(-((angle / 30) ** 2))
    density = np.clip((height - line) / edge + 0.5, 0, 1)
    outwards = (head.normals * (head.vertices - head.centre)).sum(1) > 0
    return density * (head.outer & ~head.ears & outwards)


@dataclass(frozen=True, eq=False)
class Roots:
    """K points on triangles: corners int[K, 3] vertex ids, bary [K, 3]."""

    corners: np.ndarray
    bary: np.ndarray

    def on(self, values: np.ndarray) -> np.ndarray:
        """Per-vertex [V, C] -> [K, C]."""
        return (values[self.corners] * self.bary[..., None]).sum(1)


def sample_roots(
    head: HeadMeasures, density: np.ndarray, count: int, rng: np.random.Generator, faces: np.ndarray
) -> Roots:
    """`count` random roots on triangles `faces` [F, 3], as dense as `density` [V] says."""
    a, b, c = (head.vertices[faces[:, i]] for i in range(3))
    weight = np.linalg.norm(np.cross(b - a, c - a), axis=1) * density[faces].mean(1)
    if not weight.sum() > 0 or count < 1:
        return Roots(np.zeros((0, 3), np.int64), np.zeros((0, 3)))
    chosen = rng.choice(len(faces), count, p=weight / weight.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return Roots(faces[chosen].astype(np.int64), np.stack([1 - u - v, u, v], 1))
