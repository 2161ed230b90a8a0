"""Makes `cap4d/drive/arkit_on_flame.npz`: how ICT-FaceKit's ARKit shapes move the vertices of FLAME's mesh.

    python -m cap4d.track.arkit_targets ict.npz flame.npz -o cap4d/drive/arkit_on_flame.npz

with the two rigs as `cap4d rig import` writes them. What it writes are ICT-FaceKit's offsets (MIT) taken at
other points; of FLAME it holds vertex numbers only. Which point of ICT's skin a FLAME vertex is:

1. ICT's identities, its jaw and a similarity are fitted to FLAME's template by the landmarks that both show
   (correspondence.py); lips are told apart because the jaw is open as the template's is.
2. What is left is warped by biharmonic splines: the landmarks, then thrice the distance along FLAME's
normals. 3. Each vertex takes the point that is nearest in place and normal; a vertex with none nearby is left
out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from cap4d.drive.arkit import NAMES, apple_name
from cap4d.drive.arkit_flame import Targets, write_targets
from cap4d.mesh import vertex_normals
from cap4d.rig.flame import EYES_FROM, N_VERTICES
from cap4d.rig.head import HeadRig
from cap4d.rig.ict import RANGES
from cap4d.rig.store import load_rig
from cap4d.track.correspondence import find_correspondence
from cap4d.track.neck import nearest_rotation

LANDMARK_NOISE = 0.002  # m, beside identities of one standard deviation and jaws of one weight
OUTLIER, OUTLIER_FLOOR = 4.0, 0.004  # of the median; m
FIT_ROUNDS, WARP_ROUNDS, WARP_POINTS = 12, 3, 600
STIFF_LANDMARKS, STIFF_SURFACE = 0.05, 0.1  # m of the splines' smoothing
NORMAL_REACH = 0.004  # m that opposite normals count as, halved
SPLITS = 5  # samples along an edge of a triangle
REACH, FACING = 0.006, 0.5  # m and cosine, of a vertex from its point
LIPS = ((13, 14), (82, 87), (312, 317))  # MediaPipe's landmarks inside the upper and the lower lip

Warp = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Skin:
    """ICT's skin where it has been warped to: float64[N, 3] m and int[F, 3]."""

    vertices: np.ndarray
    faces: np.ndarray


def make_targets(ict: HeadRig, flame: HeadRig) -> Targets:
    """The offsets of Apple's shapes at FLAME's vertices."""
    on_ict, on_flame = find_correspondence(ict), find_correspondence(flame)
    known = on_ict.known & on_flame.known
    goals = on_flame.points(flame.template.astype(np.float64))
    posed, scale, rotation, known = _fit(ict, on_ict.points, goals, known)
    skin = _warp(ict, posed, on_ict.points(posed), goals, known, flame)
    corners, bary, near = _attach(skin, flame)
    near &= (np.arange(N_VERTICES) < EYES_FROM) & (flame.skin_weights[:N_VERTICES, 0] < 0.5)
    vertices = np.flatnonzero(near)
    basis = ict.expression_basis[:, corners[near]].astype(np.float64)
    offsets = scale * np.einsum("pk,epkc->epc", bary[near], basis) @ rotation.T
    lips = np.array([[_vertex_at(on_flame, landmark) for landmark in pair] for pair in LIPS])
    return Targets(vertices, _by_apples_names(ict.expression_names, offsets), lips)


def _fit(
    ict: HeadRig, points: Callable, goals: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """ICT's vertices fitted to FLAME's landmarks, the similarity that took them there, and which agree."""
    jaw = ict.expression_basis[[ict.expression_names.index("jawOpen")]]
    basis = np.concatenate([ict.identity_basis, jaw]).astype(np.float64)
    at, neutral = points(basis), points(ict.template.astype(np.float64))
    coefficients, agreed = np.zeros(len(basis)), known
    for _ in range(FIT_ROUNDS):
        here = neutral + np.tensordot(coefficients, at, 1)
        scale, rotation, shift = _similarity(here[agreed], goals[agreed])
        miss = np.linalg.norm(scale * here @ rotation.T + shift - goals, axis=1)
        agreed = known & (miss < max(OUTLIER * np.median(miss[agreed]), OUTLIER_FLOOR))
        wanted = ((goals - shift) @ rotation / scale - neutral)[agreed].reshape(-1)
        system = at[:, agreed].reshape(len(basis), -1)
        normal = system @ system.T + LANDMARK_NOISE**2 * np.eye(len(basis))
        coefficients = np.linalg.solve(normal, system @ wanted)
    print(
        f"{agreed.sum()} of {known.sum()} landmarks, {1e3 * np.median(miss[agreed]):.2f} mm from ICT's "
        f"(median); its jaw is open by {coefficients[-1]:.2f}"
    )
    posed = ict.template + np.tensordot(coefficients, basis, 1)
    return scale * posed @ rotation.T + shift, scale, rotation, agreed


def _similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    rotation = nearest_rotation(b.T @ a)
    scale = float(np.trace(rotation.T @ (b.T @ a)) / (a**2).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def _warp(
    ict: HeadRig, posed: np.ndarray, at: np.ndarray, goals: np.ndarray, known: np.ndarray, flame: HeadRig
) -> Skin:
    end = RANGES["mouth_socket"][1]
    faces = ict.faces[(ict.faces < end).all(1)]
    skin = Skin(_spline(at[known], goals[known], STIFF_LANDMARKS)(posed[:end]), faces)
    template = flame.template[:N_VERTICES].astype(np.float64)
    normals = vertex_normals(flame.template.astype(np.float64), flame.faces)[:N_VERTICES]
    for turn in range(WARP_ROUNDS):
        corners, bary, near = _attach(skin, flame)
        near &= (np.arange(N_VERTICES) < EYES_FROM) & (template[:, 2] > -0.05)
        chosen = np.random.default_rng(turn).choice(np.flatnonzero(near), WARP_POINTS, replace=False)
        here = np.einsum("pk,pkc->pc", bary[chosen], skin.vertices[corners[chosen]])
        apart = ((template[chosen] - here) * normals[chosen]).sum(1, keepdims=True) * normals[chosen]
        print(f"surfaces {1e3 * np.sqrt((apart**2).sum(1).mean()):.2f} mm apart (root mean square)")
        skin = Skin(_spline(here, here + apart, STIFF_SURFACE)(skin.vertices), faces)
    return skin


def _spline(source: np.ndarray, target: np.ndarray, stiffness: float) -> Warp:
    """The smoothing biharmonic spline through pairs of points: kernel |r|, and an affine part."""
    n = len(source)
    system = np.zeros((n + 4, n + 4))
    system[:n, :n] = np.linalg.norm(source[:, None] - source, axis=2) - stiffness * np.eye(n)
    system[:n, n], system[n, :n] = 1, 1
    system[:n, n + 1 :], system[n + 1 :, :n] = source, source.T
    weights = np.linalg.solve(system, np.concatenate([target, np.zeros((4, 3))]))

    def warp(points: np.ndarray) -> np.ndarray:
        parts = []
        for part in np.array_split(points, max(len(points) // 500, 1)):
            kernel = np.linalg.norm(part[:, None] - source, axis=2)
            parts.append(kernel @ weights[:n] + weights[n] + part @ weights[n + 1 :])
        return np.concatenate(parts)

    return warp


def _attach(skin: Skin, flame: HeadRig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For FLAME's vertices: corners [V, 3] and bary [V, 3] of their points on the skin, bool[V] near
    enough.
    """
    steps = np.arange(SPLITS + 1)
    samples = np.array([(i, j, SPLITS - i - j) for i in steps for j in steps if i + j <= SPLITS]) / SPLITS
    normals = vertex_normals(skin.vertices, skin.faces)
    points, facing = (
        np.einsum("bk,fkc->fbc", samples, a[skin.faces]).reshape(-1, 3) for a in (skin.vertices, normals)
    )
    facing /= np.linalg.norm(facing, axis=1, keepdims=True) + 1e-12
    template = flame.template.astype(np.float64)
    wanted = vertex_normals(template, flame.faces)[:N_VERTICES]
    template = template[:N_VERTICES]
    tree = cKDTree(np.hstack([points, NORMAL_REACH * facing]))
    _, best = tree.query(np.hstack([template, NORMAL_REACH * wanted]))
    near = np.linalg.norm(points[best] - template, axis=1) < REACH
    near &= (facing[best] * wanted).sum(1) > FACING
    return skin.faces[best // len(samples)], samples[best % len(samples)], near


def _vertex_at(correspondence, landmark: int) -> int:
    return int(correspondence.vertices[landmark][correspondence.bary[landmark].argmax()])


def _by_apples_names(names: Sequence[str], offsets: np.ndarray) -> np.ndarray:
    """[52, P, 3]: the halves of one shape added up; zero for what ICT lacks."""
    found = np.zeros((len(NAMES), *offsets.shape[1:]))
    for name, offset in zip(names, offsets, strict=True):
        found[NAMES.index(apple_name(name))] += offset
    return found


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m cap4d.track.arkit_targets", description=__doc__.splitlines()[0]
    )
    parser.add_argument("ict", type=Path, help="rig made by `cap4d rig import ict`")
    parser.add_argument("flame", type=Path, help="rig made by `cap4d rig import flame`")
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args(argv)
    targets = make_targets(load_rig(args.ict), load_rig(args.flame))
    write_targets(args.out, targets)
    print(f"{args.out}: {len(targets.vertices)} vertices, {args.out.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
