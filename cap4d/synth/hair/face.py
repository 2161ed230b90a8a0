"""Eyebrows and eyelashes: short strands that follow the skin of the face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d import _core
from cap4d.rig.head import HeadRig
from cap4d.synth.hair.scalp import HeadMeasures, Roots

RESOLUTION = 0.00025  # m a pixel of the front view in which roots are found
BROW_WIDTH = 0.0068  # m
BROWS, LASHES = 360, 80  # strands on a side; of an upper lid
# An eyebrow when the rig has no landmarks: distance from the middle and height over the eyes, in halves of
# the distance between the eyes.
BROW_LINE = np.array([[0.42, 0.56], [0.75, 0.68], [1.15, 0.76], [1.5, 0.70], [1.78, 0.50]])
LEFT_BROW, RIGHT_BROW = slice(22, 27), slice(17, 22)  # of 68 landmarks


@dataclass(frozen=True)
class Short:
    """Short hair: its length, m, and how far it bends upwards and leaves the skin on its way, in lengths."""

    length: float
    bend: float
    lift: float


class FrontView:
    """The face seen straight from the front: which triangle lies at x, y."""

    def __init__(self, head: HeadMeasures, faces: np.ndarray) -> None:
        half = 2.6 * head.half
        self.low = np.array([-half, head.eyes[1] - head.half])
        self.size = int(2 * half / RESOLUTION)
        pixels = (head.vertices[:, :2] - self.low) / RESOLUTION
        xyz = np.column_stack([pixels, -head.vertices[:, 2]])
        self.face, self.bary = _core.rasterize_mesh(
            np.ascontiguousarray(xyz), np.ascontiguousarray(faces, np.int32), self.size, self.size, "none"
        )
        self._faces = faces

    def roots(self, xy: np.ndarray) -> Roots:
        """Roots under points [K, 2] m; those beside the face are left out."""
        column, row = np.clip(((xy - self.low) / RESOLUTION).astype(int), 0, self.size - 1).T
        seen = self.face[row, column] >= 0
        corners = self._faces[self.face[row[seen], column[seen]]]
        return Roots(corners.astype(np.int64), self.bary[row[seen], column[seen]])


def brow_lines(rig: HeadRig, head: HeadMeasures) -> list[np.ndarray]:
    """Of each side the points [5, 2] of an eyebrow, from the nose outwards."""
    marks = rig.regions.get("landmarks", ())
    if len(marks) == 68:
        points = head.vertices[np.asarray(marks)][:, :2]
        return [points[LEFT_BROW], points[RIGHT_BROW][::-1]]
    line = BROW_LINE * head.half
    return [head.eyes[:2] + line * [side, 1] for side in (1, -1)]


def grow_brows(
    lines: list[np.ndarray], head: HeadMeasures, view: FrontView, points: int, rng: np.random.Generator
) -> tuple[Roots, np.ndarray]:
    """Roots and strands [K, points, 3] m."""
    thickness, length = rng.uniform(0.75, 1.25), rng.uniform(0.005, 0.0075)
    roots, along = [], []
    for line in lines:
        t = rng.beta(1.05, 1.15, BROWS)
        knots = np.linspace(0, 1, len(line))
        middle = np.stack([np.interp(t, knots, line[:, axis]) for axis in (0, 1)], 1)
        half = 0.5 * BROW_WIDTH * thickness * np.interp(t, [0, 0.15, 0.6, 1], [0.7, 1, 0.8, 0.25])
        middle[:, 1] += np.clip(rng.normal(0, 0.5, BROWS), -1, 1) * half
        roots.append(middle)
        outwards = np.sign(line[-1, 0] - line[0, 0])
        up = np.interp(t, [0, 0.25, 0.7, 1], [0.9, 0.45, 0.0, -0.35]) + rng.normal(0, 0.22, BROWS)
        along.append(np.stack([outwards * np.ones(BROWS), up, 0.25 + 0 * up], 1))
    kind = Short(length, bend=0.1, lift=-0.02)  # they hug the brow, which curves away under them
    return _grow_short(kind, view, head, np.concatenate(roots), np.concatenate(along), points, rng)


def grow_lashes(
    rig: HeadRig, head: HeadMeasures, view: FrontView, points: int, rng: np.random.Generator
) -> tuple[Roots, np.ndarray]:
    """The same, on the edges of the upper lids: where the eyeballs' visible part ends."""
    eye = np.zeros(len(head.vertices), bool)
    eye[rig.regions.get("eyes", [])] = True
    seen = (view.face >= 0) & eye[view._faces[np.maximum(view.face, 0)]].all(-1)
    columns = np.flatnonzero(seen.any(0))
    if len(columns) < 8:
        return Roots(np.zeros((0, 3), np.int64), np.zeros((0, 3))), np.zeros((0, points, 3))
    chosen = np.sort(rng.choice(columns, 2 * LASHES))
    upper = view.size - 1 - np.argmax(seen[::-1, chosen], 0)
    xy = view.low + (np.stack([chosen, upper + 4], 1) + rng.random((len(chosen), 2))) * RESOLUTION
    outer = (np.abs(xy[:, 0]) - head.half) / (0.5 * head.half)
    way = np.stack([np.sign(xy[:, 0]) * 0.7 * outer, 0.35 + 0 * outer, 1 + 0 * outer], 1)
    way = way + rng.normal(0, 0.06, way.shape)
    return _grow_short(Short(0.0042, bend=0.9, lift=0.12), view, head, xy, way, points, rng)


def _grow_short(
    kind: Short,
    view: FrontView,
    head: HeadMeasures,
    xy: np.ndarray,
    way: np.ndarray,
    points: int,
    rng: np.random.Generator,
) -> tuple[Roots, np.ndarray]:
    """Roots under `xy` [K, 2], where there is a face, and strands that leave them along `way` [K, 3]."""
    roots = view.roots(xy)
    seen = (
        view.face[tuple(np.clip(((xy - view.low) / RESOLUTION).astype(int), 0, view.size - 1).T[::-1])] >= 0
    )
    start, normal, way = roots.on(head.vertices), roots.on(head.normals), way[seen]
    inward = np.minimum((way * normal).sum(1, keepdims=True), 0)
    way = way - inward * normal
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9) + kind.lift * normal
    t = np.linspace(0, 1, points)[None, :, None]
    far = kind.length * rng.uniform(0.6, 1.1, (len(start), 1, 1)) * t
    bend = np.array([0, 1.0, 0]) * kind.bend * t
    return roots, start[:, None] + far * (way[:, None] + bend) + 2e-4 * normal[:, None]
