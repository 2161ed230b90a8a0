"""A head of hair: grown once on a subject's neutral head, then posed with every head of that subject."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.errors import ArgumentError
from cap4d.rig.head import HeadRig
from cap4d.synth.hair.face import FrontView, brow_lines, grow_brows, grow_lashes
from cap4d.synth.hair.growth import Surface, grow
from cap4d.synth.hair.occlusion import openness
from cap4d.synth.hair.scalp import HeadMeasures, Roots, measure_head, sample_roots, scalp_density
from cap4d.synth.hair.style import HairStyle, draw_color, draw_style

BALD_POINTS = 6  # of a strand when there are only eyebrows and lashes
REAL_STRANDS = 100_000  # on a head: how many the drawn ones stand for, for their shadows
ROOT_HOLD = 0.02  # m along a strand over which it lets go of its patch of skin and follows the skull
HAIR_WIDTH = 2.2e-4  # m, of a drawn strand, which stands for several
BROW_BRIGHTEST = 0.27  # of sRGB: lit without a neighbour's shadow, they are to look darker than fair hair
DARK = 0.66  # of the skin's brightness: what a rig has painted darker on the scalp is taken for hair


@dataclass(frozen=True, eq=False)
class Hair:
    """K strands of P points (scalp, eyebrows, lashes) of one subject; everything in the rig's axes, metres.

    Args:
        style: Name of the style.
        strands: float32[K, P, 3] on the neutral head.
        roots: Where the first points lie on the mesh.
        skin: bool[K]; True where a strand follows its triangle of skin (eyebrows, lashes), else the skull.
        colors: float32[K, P, 3] sRGB albedo.
        widths: float32[K, P] m.
        through: float32[K, P, D] light that gets through to a point, of `occlusion.DIRECTIONS`.
        neutral: float64[V, 3] the head it was grown on.
        skull: int[S] vertices whose motion is the skull's.
        scalp: float32[V] share of the full density of hair over a vertex.
        shadow: float32[V] share of the light that the hair keeps from the mesh.
        color: [3] sRGB, the mean.
    """

    style: str
    strands: np.ndarray
    roots: Roots
    skin: np.ndarray
    colors: np.ndarray
    widths: np.ndarray
    through: np.ndarray
    neutral: np.ndarray
    skull: np.ndarray
    scalp: np.ndarray
    shadow: np.ndarray
    color: np.ndarray

    def __len__(self) -> int:
        return len(self.strands)

    def turn(self, vertices: np.ndarray) -> np.ndarray:
        """[3, 3] the skull's rotation from the neutral head to `vertices` [V, 3]."""
        return best_rotation(self.neutral[self.skull], np.asarray(vertices, np.float64)[self.skull])

    def pose(self, vertices: np.ndarray) -> np.ndarray:
        """The strands on posed vertices [V, 3], in the frame of these (any right-handed one).

        Hair of the scalp turns with the skull as a whole and holds on to its patch of skin near the root;
        eyebrows and lashes turn with their triangle.

        Returns:
            float32[K, P, 3] m.
        Raises:
            ArgumentError: Another number of vertices.
        """
        vertices = np.asarray(vertices, np.float64)
        if vertices.shape != self.neutral.shape:
            raise ArgumentError(f"vertices: expected {list(self.neutral.shape)}, got {list(vertices.shape)}")
        turn = self.turn(vertices)
        origin = self.neutral[self.skull].mean(0)
        moved = (self.strands - origin) @ turn.T + vertices[self.skull].mean(0)
        slip = self.roots.on(vertices) - moved[:, 0]
        hold = np.where(self.skin[:, None], 1.0, np.exp(-self._along() / ROOT_HOLD))
        points = moved + slip[:, None] * hold[..., None]
        points[self.skin] = self._on_skin(vertices, turn)
        return points.astype(np.float32)

    def _along(self) -> np.ndarray:
        """[K, P] m from the root."""
        steps = np.linalg.norm(np.diff(self.strands, axis=1), axis=-1)
        return np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, 1)], 1)

    def _on_skin(self, vertices: np.ndarray, turn: np.ndarray) -> np.ndarray:
        roots = Roots(self.roots.corners[self.skin], self.roots.bary[self.skin])
        before, after = _frames(self.neutral[roots.corners]), _frames(vertices[roots.corners])
        rotation = after @ before.swapaxes(-1, -2)
        lost = np.abs(np.linalg.det(rotation) - 1) > 1e-3  # of triangles without area
        rotation[lost] = turn
        offsets = self.strands[self.skin] - roots.on(self.neutral)[:, None]
        return roots.on(vertices)[:, None] + offsets @ rotation.swapaxes(-1, -2)


def grow_hair(
    rig: HeadRig, neutral: np.ndarray, *, seed: int, style: str | None = None, density: float = 1.0
) -> Hair:
    """Hair, eyebrows and lashes for a subject's neutral head.

    Args:
        rig: Any rig; only its faces and regions are read.
        neutral: [V, 3] m, rig axes.
        seed: Same seed, same hair.
        style: A name of `style.STYLES`; None draws one.
        density: Multiplies the number of strands.
    Raises:
        ArgumentError: No such style.
    """
    rng = np.random.default_rng([seed, 0x4A1])
    chosen, color = draw_style(rng, style), draw_color(rng)
    head = measure_head(rig, neutral)
    cover, surface = _cover(rig, head, chosen), Surface(head)
    roots = sample_roots(head, cover, round(chosen.count * density), rng, _outer_faces(rig, head))
    points = chosen.points if len(roots.bary) else BALD_POINTS
    strands = np.zeros((0, points, 3))
    if len(roots.bary):
        strands = grow(head, surface, chosen, roots.on(head.vertices), roots.on(head.normals), rng)
    return _finish(rig, head, surface, chosen.name, (roots, strands), cover, color, rng)


def _cover(rig: HeadRig, head: HeadMeasures, style: HairStyle) -> np.ndarray:
    """[V] share of the full density of hair over each vertex."""
    if not style.count:
        return np.zeros(len(head.vertices))
    cover = scalp_density(head, raised=style.raised)
    if style.raised == 0:
        cover[rig.regions.get("hair", [])] = 1
    bare = np.clip((head.height(head.vertices) - 0.35) / 0.2, 0, 1)
    return cover * (1 - (1 - style.crown) * bare)


def _outer_faces(rig: HeadRig, head: HeadMeasures) -> np.ndarray:
    """Triangles that may carry hair: where a rig has modelled hair of its own, that."""
    faces = head.faces[head.outer[head.faces].all(1)]
    if not len(rig.regions.get("hair", ())):
        return faces
    modelled = np.zeros(len(head.vertices), bool)
    modelled[rig.regions["hair"]] = True
    return faces[modelled[faces].all(1)]


def _finish(rig, head, surface, name, scalp, cover, color, rng) -> Hair:
    """Adds the face's hair, colours and shadows."""
    view, points = FrontView(head, head.faces), scalp[1].shape[1]
    lines = brow_lines(rig, head)
    brows = grow_brows(lines, head, view, points, rng)
    lashes = grow_lashes(rig, head, view, points, rng)
    parts = (scalp, brows, lashes)
    strands = np.concatenate([p[1] for p in parts])
    roots = Roots(*(np.concatenate([getattr(p[0], n) for p in parts]) for n in ("corners", "bary")))
    counts = [len(p[1]) for p in parts]
    kind = np.repeat([0, 1, 2], counts)
    through, shadow = _shadows(scalp[1], strands, head, surface)
    return Hair(
        style=name,
        strands=strands.astype(np.float32),
        roots=roots,
        skin=kind > 0,
        colors=_colors(strands, kind, color, rng),
        widths=_widths(strands, kind, rng),
        through=through,
        neutral=head.vertices,
        skull=_skull(head),
        scalp=cover.astype(np.float32),
        shadow=shadow,
        color=color,
    )


def _shadows(scalp, strands, head: HeadMeasures, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    from cap4d.synth.hair.occlusion import DIRECTIONS

    if not len(scalp):
        open_ = np.ones((*strands.shape[:2], len(DIRECTIONS)), np.float32)
        return open_, np.zeros(len(head.vertices), np.float32)
    around = openness(scalp, REAL_STRANDS / len(scalp), lambda points: surface.near(points)[0] < -0.004)
    through = around.at(strands)
    facing = np.clip(head.normals @ DIRECTIONS.T + 0.1, 0, None)
    seen = around.at(head.vertices + 0.006 * head.normals)
    shadow = 1 - (seen * facing).sum(1) / np.maximum(facing.sum(1), 1e-9)
    return through, np.where(head.outer, np.clip(0.75 * shadow, 0, 0.7), 0).astype(np.float32)


def _colors(strands: np.ndarray, kind: np.ndarray, color: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """float32[K, P, 3]: strands differ, roots are darker than tips; brows and lashes are darker than hair."""
    count, points = strands.shape[:2]
    locks = np.sin(strands[:, 0] @ rng.normal(0, 160, (3, 3)) + rng.uniform(0, 6, 3)).mean(1)
    tone = np.exp(rng.normal(0, 0.16, count) + 0.16 * locks)[:, None, None]
    tone = tone * np.exp(rng.normal(0, 0.03, (count, 1, 3)))
    along = np.linspace(0, 1, points)[None, :, None]
    grey = np.full(3, color.mean())
    face = 0.55 * (0.75 * color + 0.25 * grey * [1.15, 1.0, 0.85])
    face = face * min(1, BROW_BRIGHTEST / face.max())
    base = np.stack([color, face, 0.3 * face])[kind][:, None]
    return np.clip(base * tone * (0.82 + 0.3 * along) + 0.01, 0, 1).astype(np.float32)


def _widths(strands: np.ndarray, kind: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    along = np.linspace(0, 1, strands.shape[1])
    width = HAIR_WIDTH * np.array([1.0, 0.75, 0.45])[kind] * rng.uniform(0.7, 1.3, len(strands))
    return (width[:, None] * np.interp(along, [0, 0.6, 1], [1, 1, 0.3])).astype(np.float32)


def _skull(head: HeadMeasures) -> np.ndarray:
    """Vertices of the upper, hinder head, which expressions leave alone."""
    high, behind = head.height(head.vertices) > 0.35, head.angle(head.vertices) > 60
    ids = np.flatnonzero(high & behind & head.outer)
    return ids if len(ids) >= 3 else np.flatnonzero(head.outer)


def _frames(corners: np.ndarray) -> np.ndarray:
    """[K, 3, 3] orthonormal frames (columns) of triangles [K, 3, 3]; zero without area."""
    edge = corners[:, 1] - corners[:, 0]
    normal = np.cross(edge, corners[:, 2] - corners[:, 0])
    x, z = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-15) for v in (edge, normal))
    return np.stack([x, np.cross(z, x), z], -1)


def best_rotation(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[3, 3] the rotation that best takes points [S, 3] to others (Kabsch 1976)."""
    u, _, vt = np.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    return (u @ flip @ vt).T
