"""Strands grown over a head: combed, falling, kept off the skin, gathered in tufts, curled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.synth.hair.scalp import HeadMeasures
from cap4d.synth.hair.style import HairStyle

MARGIN = 0.0012  # m; strands stay this far off the head
PUSH_MOST = 0.008  # m; what seems to lie deeper does so beside an edge, where the distance is wrong
SUBSTEPS = 2  # of growing between two points of a strand
CROWN = 0.93, -0.45  # the whorl: its height, and its place behind the skull's axis, in skull units
EAR_DOME = 0.006  # m; how far hair that lies over an ear is bulged by it
FACE_HALF = 0.062  # m; hair that hangs is kept off a face this wide


class Surface:
    """Distance to a head without its ears, from the nearest of its vertices and triangle centres."""

    def __init__(self, head: HeadMeasures) -> None:
        from scipy.spatial import cKDTree

        open_, plugs = _without_ears(head)
        faces = head.faces[open_[head.faces].all(1)]
        used = np.zeros(len(head.vertices), bool)
        used[faces] = True
        points = np.concatenate([head.vertices[used], head.vertices[faces].mean(1), *plugs])
        sideways = [np.tile([np.sign(plug[0, 0]), 0.0, 0.0], (len(plug), 1)) for plug in plugs]
        normals = np.concatenate([head.normals[used], head.normals[faces].mean(1), *sideways])
        keep = np.isfinite(points).all(1) & (np.linalg.norm(normals, axis=1) > 0.5)
        self._points, self._normals = points[keep], normals[keep]
        self._tree = cKDTree(self._points, balanced_tree=False, compact_nodes=False)

    def near(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distance [...] and outward normal [..., 3] of points [..., 3]."""
        flat = points.reshape(-1, 3)
        far, ids = self._tree.query(flat, k=3)
        weights = 1 / (far + 1e-4)
        weights /= weights.sum(1, keepdims=True)
        normals = _unit((self._normals[ids] * weights[..., None]).sum(1))
        offset = flat - (self._points[ids] * weights[..., None]).sum(1)
        distance = (offset * normals).sum(1)
        # far from the surface its tangent plane says nothing
        distance = np.where(distance > 0, np.maximum(distance, 0.7 * far[:, 0]), distance)
        return distance.reshape(points.shape[:-1]), normals.reshape(points.shape)

    def push_out(self, points: np.ndarray, margin: float = MARGIN) -> np.ndarray:
        """The points [..., 3], those within `margin` of the head moved out."""
        distance, normals = self.near(points)
        out = points + np.clip(margin - distance, 0, PUSH_MOST)[..., None] * normals
        deep = distance < margin - PUSH_MOST
        if deep.any():
            distance, normals = self.near(out[deep])
            out[deep] += np.clip(margin - distance, 0, PUSH_MOST)[:, None] * normals
        return out


def _without_ears(head: HeadMeasures) -> tuple[np.ndarray, list[np.ndarray]]:
    """bool[V] of the skin around the ears, and points [N, 3] that close each of the holes."""
    open_, plugs = head.outer.copy(), []
    for side in (1, -1):
        ear = head.vertices[head.ears & (side * head.vertices[:, 0] > 0)]
        if not len(ear):
            continue
        middle, reach = (ear.min(0) + ear.max(0)) / 2, 0.55 * np.ptp(ear, 0) + 1e-3
        r2 = (((head.vertices - middle)[:, 1:] / reach[1:]) ** 2).sum(1)
        beside = side * head.vertices[:, 0] > 0.5 * side * middle[0]
        rim = head.outer & ~head.ears & beside & (r2 > 1) & (r2 < 1.8)
        open_ &= ~(beside & (r2 <= 1)) & ~head.ears
        grid = np.stack(np.meshgrid(np.linspace(-1, 1, 17), np.linspace(-1, 1, 17)), -1).reshape(-1, 2)
        grid = grid[(grid**2).sum(1) < 1]
        width = np.median(np.abs(head.vertices[rim, 0])) if rim.any() else np.abs(ear[:, 0]).min()
        x = side * (width + EAR_DOME * (1 - (grid**2).sum(1)))
        plugs.append(np.column_stack([x, middle[1:] + grid * reach[1:]]))
    return open_, plugs


@dataclass(frozen=True, eq=False)
class Comb:
    """Directions of growth about one head for one style."""

    head: HeadMeasures
    style: HairStyle

    def direction(self, points: np.ndarray, roots: np.ndarray) -> np.ndarray:
        """[K, 3] where hair of `roots` [K, 3] is combed at `points` [K, 3]; not tangent yet, about unit."""
        head, style = self.head, self.style
        height = head.height(roots)
        crown = head.centre + np.array([0.004, (CROWN[0] - 0.1) * head.unit, CROWN[1] * head.unit])
        flow = _unit(points - crown)
        top = _ramp(height, 0.45, 0.8)[:, None]
        flow = flow + top * np.array(style.sweep)
        if style.part is not None:
            front = _ramp(roots[:, 2] - crown[2], -0.01, 0.04)
            side = np.where(roots[:, 0] > style.part, 1.0, -1.0)
            away = np.stack([side, 0 * side - 0.1, 0 * side - 0.35], 1)
            flow = flow * (1 - front)[:, None] + away * front[:, None]
        return flow + self._off_face(points, height) * (style.fringe is None)

    def _off_face(self, points: np.ndarray, root_height: np.ndarray) -> np.ndarray:
        """Keeps the face free: sideways and back, the more the lower before it a point lies."""
        head = self.head
        before = _ramp(points[:, 2] - head.eyes[2], -0.035, 0.0) * _ramp(head.height(points), 0.66, 0.5)
        before = before * _ramp(np.abs(points[:, 0]), FACE_HALF + 0.03, FACE_HALF)
        side = np.where(points[:, 0] > 0, 1.0, -1.0)
        return before[:, None] * np.stack([1.6 * side, 0 * side - 0.5, 0 * side - 1.2], 1)


def strand_lengths(
    head: HeadMeasures, style: HairStyle, roots: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """[K] m"""
    height, angle = head.height(roots), head.angle(roots)
    length = style.side + (style.top - style.side) * _ramp(height, 0.0, 0.85)
    jitter = rng.uniform(0.65, 1.05, len(roots))
    if style.cut is not None:
        over = np.linalg.norm((roots - head.centre)[:, [0, 2]], axis=1)
        around = np.maximum(0.085 - over, 0)  # from the top the way leads sideways first
        length = (height - style.cut) * head.unit + 0.9 * around
        jitter = rng.uniform(0.9, 1.02, len(roots))
    if style.fringe is not None:
        front = _ramp(angle, 62, 42) * _ramp(height, 0.4, 0.6)
        reach = (height - style.fringe) * head.unit + np.maximum(head.eyes[2] - 0.01 - roots[:, 2], 0)
        length = length * (1 - front) + front * np.clip(reach, 0.01, 0.12)
    return length * jitter


def grow(
    head: HeadMeasures,
    surface: Surface,
    style: HairStyle,
    roots: np.ndarray,
    normals: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Strands [K, P, 3] m from roots [K, 3] with skin normals [K, 3]."""
    lengths = strand_lengths(head, style, roots, rng)
    strands = _comb(head, surface, style, roots, normals, lengths, rng)
    strands = _curl(strands, lengths, style, rng)
    strands = _gather(strands, roots, style, rng)
    strands = _frizz(strands, style, rng)
    body = surface.push_out(strands[:, 1:])
    return np.concatenate([roots[:, None], body], 1)


def _comb(head, surface, style, roots, normals, lengths, rng):
    comb, count = Comb(head, style), len(roots)
    step = (lengths / ((style.points - 1) * SUBSTEPS))[:, None]
    layer = (
        style.lift
        * rng.uniform(0.25, 1.0, count) ** 0.8
        * (0.45 + 0.55 * _ramp(head.height(roots), 0.0, 0.6))
    )
    layer = np.minimum(layer, 0.8 * lengths)
    lean = rng.normal(0, 0.10, (count, 3))
    points, travelled = roots.copy(), np.zeros((count, 1))
    heading = _unit(0.6 * normals + comb.direction(roots, roots))
    strands = [roots]
    for _ in range(style.points - 1):
        for _ in range(SUBSTEPS):
            distance, normal = surface.near(points)
            flow = comb.direction(points, roots) + lean
            loose = _ramp(distance, 0.02, 0.06)[:, None]
            flow = flow - (flow * normal).sum(1, keepdims=True) * normal * (1 - loose)
            flow = _unit(flow) * (1 - 0.9 * loose)
            wanted = layer * (1 - np.exp(-travelled[:, 0] / (0.7 * style.lift + 1e-6)))
            rise = np.clip((wanted + 0.2 * layer - distance) / np.maximum(style.lift, 4e-3), -0.8, 1.5)[
                :, None
            ]
            rise = rise * (1 - loose)
            pull = style.gravity * (1 + 4 * loose) * np.array([0.0, -1.0, 0.0])
            heading = _unit((0.9 - 0.35 * loose) * heading + 0.55 * (flow + pull + rise * normal))
            points = points + step * heading
            left = distance + step[:, 0] * (heading * normal).sum(1)
            points = points + np.clip(MARGIN - left, 0, PUSH_MOST)[:, None] * normal
            travelled = travelled + step
        strands.append(points)
    return np.stack(strands, 1)


def _gather(strands: np.ndarray, roots: np.ndarray, style: HairStyle, rng: np.random.Generator) -> np.ndarray:
    """Leans strands towards the middle of their tuft, more towards the tips."""
    if style.clump <= 0 or len(roots) < style.clumps:
        return strands
    from scipy.spatial import cKDTree

    guides = rng.choice(len(roots), style.clumps, replace=False)
    tuft = guides[cKDTree(roots[guides]).query(roots)[1]]
    along = np.linspace(0, 1, strands.shape[1])[None, :, None]
    apart = np.linalg.norm(strands[:, -1] - strands[tuft, -1], axis=1)[:, None, None]
    strength = style.clump * rng.uniform(0.4, 1.3, (len(roots), 1, 1)) * _ramp(apart, 0.06, 0.02)
    return strands + np.clip(strength, 0, 0.9) * along * (strands[tuft] - strands)


def _curl(strands: np.ndarray, lengths: np.ndarray, style: HairStyle, rng: np.random.Generator) -> np.ndarray:
    if style.wave <= 0:
        return strands
    tangent = _unit(np.gradient(strands, axis=1))
    side = _unit(np.cross(tangent, [0.31, 0.2, 0.93]))
    count, points = strands.shape[:2]
    along = np.linspace(0, 1, points) * lengths[:, None]
    # neighbours curl together: the phase varies slowly over the head, a little from strand to strand
    where = strands[:, 0] @ rng.normal(0, 90, (3, 2))
    phase = 2.5 * np.sin(where).sum(1) + rng.normal(0, 0.45, count)
    turn = 2 * np.pi * along / (style.wavelength * rng.uniform(0.8, 1.25, (count, 1))) + phase[:, None]
    radius = style.wave * np.minimum(along / style.wavelength * 1.5, 1) * rng.uniform(0.6, 1.2, (count, 1))
    ring = np.cos(turn)[..., None] * side + np.sin(turn)[..., None] * np.cross(tangent, side)
    return strands + radius[..., None] * (ring - ring[:, :1])


def _frizz(strands: np.ndarray, style: HairStyle, rng: np.random.Generator) -> np.ndarray:
    """Smooth displacements of single strands; a few fly off."""
    count, points = strands.shape[:2]
    along = np.linspace(0, 1, points)
    amount = style.frizz * rng.gamma(2, 0.4, count) * np.where(rng.random(count) < 0.01, 2, 1)
    bend, sway = rng.normal(0, 0.6, (2, count, 1, 3))
    wave = np.sin(np.pi * along * rng.uniform(0.8, 2.5, (count, 1)))[..., None]
    return strands + amount[:, None, None] * (bend * along[:, None] ** 1.5 + sway * wave * along[:, None])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def _ramp(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 at `start`, 1 at `end`, smooth between."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)
