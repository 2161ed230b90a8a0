"""Vertices back to expressions: exact where the data say it, bounded where they do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from drive_bundle import on_rig
from tiny_bundle import tiny_bundle, tiny_clip

from cap4d.bundle import Bundle
from cap4d.drive.retarget import Retargeter
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError
from cap4d.rig.grid import own_triangles
from cap4d.rig.head import HeadRig

RNG = np.random.default_rng(3)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.linalg.norm(a - b, axis=-1))


@pytest.fixture(scope="module")
def head(builtin_rig: HeadRig) -> Bundle:
    return on_rig(builtin_rig, size=64)


def moving_joints(bundle: Bundle) -> np.ndarray:
    """bool[E] expressions that turn a joint, whose motion is not linear."""
    turns = bundle.subject.expr_rotation
    return np.zeros(bundle.n_expressions, bool) if turns is None else np.abs(turns).max(1) > 0


def test_the_built_in_head_gives_its_expressions_and_gaze_back(head: Bundle) -> None:
    frames = 24
    expr = RNG.uniform(0, 1, (frames, head.n_expressions)).astype(np.float32) * ~moving_joints(head)
    gaze = RNG.uniform(-0.3, 0.3, (frames, 3)).astype(np.float32) * np.float32([1, 1, 0])
    mesh = head.mesh_subject
    found = Retargeter(head, len(mesh.neutral))(mesh.pose(expr, eye_rot=gaze), mesh.pose(0 * expr[0]))
    # On so coarse a grid a pair of gaze shapes moves the lids alike, by less than the ridge tells apart.
    assert np.sqrt(((found.expr - expr) ** 2).mean()) < 0.04
    rebuilt = head.subject.pose(found.expr, eye_rot=found.eye_rot)
    assert np.abs(rebuilt - head.subject.pose(expr, eye_rot=gaze)).max() < 1e-4
    assert angle_deg(found.eye_rot, gaze).max() < 0.2
    assert found.residual_mm.max() < 0.02


def test_an_avatar_on_the_rigs_own_triangles(head: Bundle, builtin_rig: HeadRig) -> None:
    """What its vertices do is what the frames say, vertex by vertex."""
    mesh = head.mesh_subject
    grid = own_triangles(builtin_rig)
    plain = replace(head, grid=grid, subject=mesh, deform_neutral=np.zeros_like(mesh.neutral))
    expr = RNG.uniform(0, 1, (4, head.n_expressions)).astype(np.float32) * ~moving_joints(head)
    gaze = np.tile(np.float32([0.1, -0.2, 0]), (4, 1))
    found = Retargeter(plain, len(grid))(mesh.pose(expr, eye_rot=gaze), mesh.pose(0 * expr[0]))
    assert np.sqrt(((found.expr - expr) ** 2).mean()) < 0.04
    assert angle_deg(found.eye_rot, gaze).max() < 0.2


def test_another_person_on_the_same_mesh(head: Bundle, builtin_rig: HeadRig) -> None:
    """Displacements carry over: the source's identity is not the avatar's."""
    other = builtin_rig.subject(RNG.normal(size=builtin_rig.n_identity).astype(np.float32))
    expr = RNG.uniform(0, 1, (5, head.n_expressions)).astype(np.float32) * ~moving_joints(head)
    found = Retargeter(head, len(other.neutral))(other.pose(expr), other.pose(0 * expr[0]))
    assert np.sqrt(((found.expr - expr) ** 2).mean()) < 0.04


def test_still_eyeballs_are_no_gaze(head: Bundle) -> None:
    mesh = head.mesh_subject
    expr = 0.5 * np.eye(head.n_expressions, dtype=np.float32)[:4]
    found = Retargeter(head, len(mesh.neutral))(mesh.pose(expr), mesh.pose(0 * expr[0]))
    assert not found.eye_rot.any()


def test_noise_stays_small_and_shows_in_the_residual(head: Bundle) -> None:
    mesh, sigma = head.mesh_subject, 2e-4
    expr = RNG.uniform(0, 1, (8, head.n_expressions)).astype(np.float32) * ~moving_joints(head)
    vertices = mesh.pose(expr)
    noisy = vertices + RNG.normal(0, sigma, vertices.shape).astype(np.float32)
    found = Retargeter(head, len(mesh.neutral))(noisy, mesh.pose(0 * expr[0]))
    rebuilt = mesh.pose(found.expr)
    assert np.sqrt(((rebuilt - vertices) ** 2).mean()) < sigma, "the face moves less than the noise did"
    assert 0.1 < np.median(found.residual_mm) < 1e3 * sigma * np.sqrt(3)


def test_a_mesh_that_covers_part_of_the_avatar_is_enough(head: Bundle) -> None:
    """As FLAME's own mesh does, which lacks the mouth's inside (fact 14)."""
    mesh = head.mesh_subject
    count = int(0.9 * len(mesh.neutral))
    expr = RNG.uniform(0, 1, (4, head.n_expressions)).astype(np.float32) * ~moving_joints(head)
    vertices = mesh.pose(expr)[:, :count]
    found = Retargeter(head, count)(vertices, mesh.pose(0 * expr[0])[:count])
    rebuilt = head.subject.pose(found.expr)
    covered = (head.grid.vertices < count).all(1)
    assert covered.sum() < len(covered)
    assert np.abs(rebuilt - head.subject.pose(expr))[:, covered].max() < 5e-5


def test_a_mesh_that_covers_next_to_nothing_is_refused(head: Bundle) -> None:
    with pytest.raises(ArgumentError, match="expected a mesh that covers"):
        Retargeter(head, 3)


def test_the_clip_has_no_neck_jaw_or_pose() -> None:
    bundle = tiny_bundle(8, network=False)
    mesh, clip = bundle.mesh_subject, tiny_clip(70)
    made = Retargeter(bundle, len(mesh.neutral))(mesh.pose(clip.expr), mesh.pose(0 * clip.expr[0])).clip(30.0)
    assert made.rig_name == bundle.rig_name and len(made) == 70 and made.fps == 30
    assert made.rot is None and not made.neck_rot.any() and not made.jaw_rot.any()


@pytest.fixture(scope="module")
def flame(shared: Path) -> Bundle:
    from cap4d.rig.flame import import_flame

    folder = shared / "flame"
    return on_rig(import_flame(folder / "flame_standin.pkl", folder / "cap4d_assets"))


def test_codetalker_vertices_give_their_expressions_back(flame: Bundle, shared: Path, tmp_path: Path) -> None:
    """The issue's example: within 0.3 per cent of the expressions' spread. The source holds no gaze."""
    folder = shared / "flame/codetalker"
    truth = np.load(folder / "truth.npz")
    np.save(tmp_path / "template.npy", truth["template"])
    spec = str(next(folder.glob("*.npy")))
    clip = open_source(spec, flame, template=tmp_path / "template.npy")
    error = np.sqrt(((clip.expr - truth["expr"]) ** 2).mean())
    worst, spread = np.abs(clip.expr - truth["expr"]).max(), truth["expr"].std()
    print(f"expression error {error:.5f} root mean square, worst {worst:.4f}, spread {spread:.3f}")
    assert error < 0.003 * spread
    assert len(clip) == len(truth["expr"]) and not clip.eye_rot.any()
    first = open_source(spec, flame)
    spread = (truth["expr"] - truth["expr"][0]).std()
    assert np.sqrt(((first.expr - (truth["expr"] - truth["expr"][0])) ** 2).mean()) < 0.003 * spread


def test_flame_sequences_and_their_gaze_survive_the_mesh(flame: Bundle, shared: Path) -> None:
    clip = open_source(str(shared / "flame/sequence_00/fit.npz"), flame)
    assert (len(clip), clip.fps, clip.rot is not None) == (384, 24, True)
    expr, gaze, mesh = clip.expr[::16], clip.eye_rot[::16], flame.mesh_subject
    vertices = mesh.pose(expr, eye_rot=gaze)[:, :5023]
    found = Retargeter(flame, 5023)(vertices, mesh.pose(0 * expr[0])[:5023])
    assert np.sqrt(((found.expr - expr) ** 2).mean()) < 0.003 * expr.std()
    assert angle_deg(found.eye_rot, gaze).max() < 0.01
    assert found.residual_mm.max() < 0.001
