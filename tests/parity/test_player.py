"""The player against the facts, evaluated plainly in float64: rig, network, frames, Gaussians, picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import tiny_bundle
from tolerances import (
    PLAYER_HALF_DB,
    PLAYER_MEANS,
    PLAYER_NEUTRAL,
    PLAYER_PICTURE,
    PLAYER_QUATS,
    PLAYER_SCALES,
    PLAYER_VERTICES,
)

from cap4d.bundle import Bundle, read_bundle, write_bundle
from cap4d.gaussians import Gaussians
from cap4d.player.avatar import Avatar
from cap4d.render import render

FLIP = np.array([1.0, -1.0, -1.0])
CASES = {
    "neutral": {},
    "expression": dict(expr=[1, -0.5, 0.3, 0.8, -1]),
    "eyes": dict(expr=[0, 1, 1, 0, 0], eye_rot=[0.2, -0.3, 0.05]),
    "neck": dict(expr=[0.4, 0, 0, 0.4, 0], neck_rot=[0.3, 0.1, -0.2]),
    "everything": dict(expr=[1.5, -1, 2, 0.1, 0.7], eye_rot=[-0.2, 0.1, 0], neck_rot=[0.1, 0.4, 0.2]),
}


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return tiny_bundle(16, gaussians=2)


def rotation(rotvec: np.ndarray) -> np.ndarray:
    """Rodrigues' formula, for one vector."""
    angle = np.linalg.norm(rotvec)
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(rotvec) / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def posed(bundle: Bundle, expr: np.ndarray, eye_rot=(0, 0, 0), neck_rot=(0, 0, 0)) -> np.ndarray:
    """Facts 6 to 8 and 13, point by point."""
    s = bundle.subject.map(lambda a: a.astype(np.float64))
    turns = {"eyes": np.array(eye_rot), "neck": np.array(neck_rot), "expr": expr @ s.expr_rotation}
    rotations = [rotation(turns[driver]) for driver in s.joint_drivers]
    out = np.zeros_like(s.neutral)
    for v in range(len(out)):
        x = (
            s.neutral[v]
            + sum(e * b for e, b in zip(expr, s.expression_basis[:, v], strict=True))
            + s.pose_offset[v]
        )
        for j, R in enumerate(rotations):
            x = x + (R - np.eye(3)).ravel() @ s.pose_basis[9 * j : 9 * j + 9, v]
        total = (1 - s.skin_weights[v].sum()) * x
        for j, R in enumerate(rotations):
            centre = s.joints[j] + expr @ s.joints_expression[:, j]
            total = total + s.skin_weights[v, j] * (R @ (x - centre) + centre)
        out[v] = total
    return out


def convolve(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """[C, S, S] and [K, C, 5, 5] -> [K, S, S], zero padding."""
    size = image.shape[1]
    padded = np.pad(image, ((0, 0), (2, 2), (2, 2)))
    return sum(
        np.einsum("kc,cij->kij", weight[:, :, a, b], padded[:, a : a + size, b : b + size])
        for a in range(5)
        for b in range(5)
    )


def network(bundle: Bundle, offsets: np.ndarray) -> np.ndarray:
    """The tiny network in float64 on a map [3, S, S]."""
    import onnx
    from onnx import numpy_helper

    graph = onnx.load_from_string(bundle.deform_onnx).graph
    weights = {t.name: numpy_helper.to_array(t).astype(np.float64) for t in graph.initializer}
    hidden = np.tanh(convolve(offsets * weights["scale"], weights["weight"]) + weights["bias"][:, None, None])
    return convolve(hidden, weights["weight2"]) * weights["unscale"][0]


def vertices(bundle: Bundle, expr: np.ndarray, **rotations: object) -> np.ndarray:
    """Facts 20 and 24."""
    grid, zero = bundle.grid, np.zeros_like(expr)
    straight = {k: v for k, v in rotations.items() if k != "neck_rot"}
    offsets = np.zeros((3, grid.size, grid.size))
    rows, columns = grid.pixels.T.astype(int)
    offsets[:, rows, columns] = ((posed(bundle, expr, **straight) - posed(bundle, zero)) * FLIP).T
    moved = network(bundle, offsets)[:, rows, columns].T
    neutral = network(bundle, 0 * offsets)[:, rows, columns].T
    deformation = np.where(grid.deformable[:, None], moved, neutral)
    return posed(bundle, expr, **rotations) * FLIP + deformation


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's, one by one."""
    w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([w, *v])


def quaternion(R: np.ndarray) -> np.ndarray:
    """Unit wxyz of a rotation matrix: the eigenvector of Bar-Itzhack 2000, which has no special cases."""
    k = np.zeros((4, 4))
    k[0, 0] = np.trace(R)
    k[0, 1:] = k[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    k[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return np.linalg.eigh(k)[1][:, -1]


def bound(bundle: Bundle, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fact 27, Gaussian by Gaussian."""
    means, quats, scales = [], [], []
    for i, face in enumerate(bundle.binding):
        v0, v1, v2 = points[bundle.grid.faces[face]]
        a0 = (v1 - v0) / np.linalg.norm(v1 - v0)
        a1 = np.cross(a0, v2 - v0)
        a1 /= np.linalg.norm(a1)
        a2 = -np.cross(a1, a0)
        size = (np.linalg.norm(v1 - v0) + abs(a2 @ (v2 - v0))) / 2
        R = np.stack([a0, a1, a2], 1)
        local = bundle.quats[i].astype(np.float64)
        means.append(R @ bundle.means[i].astype(np.float64) * size + (v0 + v1 + v2) / 3)
        quats.append(product(quaternion(R), local / np.linalg.norm(local)))
        scales.append(np.exp(bundle.log_scales[i].astype(np.float64)) * size)
    return np.array(means), np.array(quats), np.array(scales)


@pytest.mark.parametrize("case", CASES)
def test_vertices_and_gaussians(case: str, bundle: Bundle) -> None:
    pose = {k: np.array(v, np.float64) for k, v in CASES[case].items()}
    expr = pose.pop("expr", np.zeros(bundle.n_expressions))
    avatar, expected = Avatar(bundle), vertices(bundle, expr, **pose)
    np.testing.assert_allclose(avatar.vertices(expr, **pose), expected, rtol=0, atol=PLAYER_VERTICES)
    found, (means, quats, scales) = avatar.pose(expr, **pose), bound(bundle, expected)
    np.testing.assert_allclose(found.means, means, rtol=0, atol=PLAYER_MEANS)
    np.testing.assert_allclose(found.scales, scales, rtol=PLAYER_SCALES)
    alike = np.abs((found.quats * quats).sum(1))  # q and -q are one rotation
    np.testing.assert_allclose(alike, 1, rtol=0, atol=PLAYER_QUATS)


def test_the_baked_neutral_correction_is_the_network_at_rest(bundle: Bundle) -> None:
    rows, columns = bundle.grid.pixels.T.astype(int)
    expected = network(bundle, np.zeros((3, bundle.grid.size, bundle.grid.size)))[:, rows, columns].T
    np.testing.assert_allclose(bundle.deform_neutral, expected, rtol=0, atol=PLAYER_NEUTRAL)


def test_the_picture_is_that_of_the_plainly_posed_gaussians(bundle: Bundle) -> None:
    pose = {k: np.array(v, np.float64) for k, v in CASES["everything"].items()}
    expr = pose.pop("expr")
    means, quats, scales = (a.astype(np.float32) for a in bound(bundle, vertices(bundle, expr, **pose)))
    opacities = (1 / (1 + np.exp(-bundle.opacity_logits.astype(np.float64)))).astype(np.float32)
    plain = render(Gaussians(means, quats, scales, opacities, bundle.sh), bundle.camera, background=(1, 1, 1))
    found = Avatar(bundle).render(expr, background=(1, 1, 1), **pose)[..., :3].astype(float)
    difference = np.abs(found - 255 * np.clip(plain.rgb, 0, 1))
    # A cut-off that flips where two roundings disagree moves a pixel by more: at most one in a thousand.
    assert np.quantile(difference, 0.999) <= PLAYER_PICTURE
    assert found.std() > 20


def test_a_float16_bundle_plays_alike(bundle: Bundle, tmp_path: Path) -> None:
    write_bundle(bundle, tmp_path / "half.cap4d", precision="float16")
    half, full = Avatar(read_bundle(tmp_path / "half.cap4d")), Avatar(bundle)
    expr = np.float32(CASES["everything"]["expr"])
    pictures = [a.render(expr, background=(1, 1, 1))[..., :3].astype(float) for a in (half, full)]
    mse = np.mean((pictures[0] - pictures[1]) ** 2)
    assert 0 < mse < 255**2 / 10 ** (PLAYER_HALF_DB / 10)
