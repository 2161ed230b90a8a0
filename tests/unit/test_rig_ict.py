"""ICT-FaceKit Light as a rig: counts, eyes, jaw, neck, shoulders, atlas; both forms it is distributed in."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from cap4d.errors import DataError
from cap4d.rig.grid import build_grid
from cap4d.rig.head import HeadRig
from cap4d.rig.ict import LANDMARKS, N_KEPT, import_ict


@pytest.fixture(scope="module")
def rig(shared) -> HeadRig:
    return import_ict(shared / "ict" / "ict_facekit_light.npz")


@pytest.fixture(scope="module")
def grid(rig):
    return build_grid(rig)


def posed(rig, *, shape=None, **expressions):
    rotations = {name: expressions.pop(name) for name in ("eye_rot", "neck_rot") if name in expressions}
    expr = np.zeros(rig.n_expressions, np.float32)
    for name, value in expressions.items():
        expr[rig.expression_names.index(name)] = value
    return rig.subject(shape).pose(expr, **rotations)


def test_counts_and_names(rig):
    assert (rig.name, rig.licence) == ("ict_facekit_light", "MIT")
    assert (rig.n_identity, rig.n_expressions) == (100, 53)
    assert {"jawOpen", "eyeBlink_L", "eyeBlink_R", "mouthSmile_L", "cheekPuff_R"} <= set(rig.expression_names)
    assert len(rig.template) == N_KEPT + len(rig.regions["bust"])
    assert rig.joint_drivers == ("neck", "eyes", "eyes")


def test_metres_and_axes(rig):
    head = rig.template[rig.regions["face"]]
    assert 0.22 < np.ptp(head[:, 1]) < 0.30 and 0.15 < np.ptp(head[:, 0]) < 0.20
    left, right = rig.joints[1:]
    assert left[0] > 0.028 and right[0] < -0.028  # x to the person's left
    assert rig.template[LANDMARKS[30], 2] > left[2] + 0.03  # the nose in front of the eyes
    np.testing.assert_allclose((left + right) / 2, [0, 0.0233, 0.006], atol=2e-3)  # FLAME's origin


@pytest.mark.parametrize(("joint", "region"), [(1, "eye_left"), (2, "eye_right")])
def test_eyes_turn_about_their_centres(rig, joint, region):
    ids = rig.regions[region]
    shape = np.random.default_rng(0).normal(size=rig.n_identity).astype(np.float32)
    turned = posed(rig, shape=shape, eye_rot=np.float32([0.1, 0.4, 0]))
    still = posed(rig, shape=shape)
    centre = rig.subject(shape).joints[joint]
    radius_before = np.linalg.norm(still[ids] - centre, axis=1)
    np.testing.assert_allclose(np.linalg.norm(turned[ids] - centre, axis=1), radius_before, atol=1e-6)
    assert np.linalg.norm(turned[ids] - still[ids], axis=1).max() > 4e-3
    ball = radius_before[still[ids, 2] < centre[2]]  # the back half, without the cornea
    assert np.std(ball) < 0.05 * np.mean(ball)  # the centre really is the ball's, for any identity
    others = np.setdiff1d(rig.faces, np.concatenate([rig.regions["eye_left"], rig.regions["eye_right"]]))
    np.testing.assert_array_equal(turned[others], still[others])


def test_gaze_expressions_move_lids_and_leave_the_balls(rig):
    down = posed(rig, eyeLookDown_L=1) - posed(rig)
    assert np.abs(down[rig.regions["eyes"]]).max() == 0
    assert np.abs(down[rig.regions["face"]]).max() > 5e-3


def test_blink_closes_the_lids(rig):
    upper, lower = LANDMARKS[[43, 44]], LANDMARKS[[47, 46]]  # of the left eye
    gap_open = (posed(rig)[upper] - posed(rig)[lower])[:, 1]
    gap_shut = (posed(rig, eyeBlink_L=1)[upper] - posed(rig, eyeBlink_L=1)[lower])[:, 1]
    assert (gap_open > 8e-3).all() and (gap_shut < 2e-3).all()


def test_jaw_takes_lower_teeth_and_tongue_along(rig):
    moved = posed(rig, jawOpen=1) - posed(rig)
    down = -moved[:, 1]
    upper_teeth, lower_teeth = slice(17039, 19247), slice(19247, 21451)
    assert down[lower_teeth].min() > 0.01 and np.abs(moved[upper_teeth]).max() < 1e-3
    assert down[14062:17039].max() > 0.02  # gums and tongue


def test_neck_bends_under_a_fixed_head(rig):
    moved = np.linalg.norm(posed(rig, neck_rot=np.float32([0, 0.3, 0])) - posed(rig), axis=1)
    assert moved[rig.regions["bust"]].max() > 0.03
    rigid = np.concatenate([LANDMARKS, rig.regions["eyes"], rig.regions["teeth"], rig.regions["mouth"]])
    assert moved[rigid].max() == 0
    weight = rig.skin_weights[:, 0]
    step = np.abs(np.diff(weight[rig.faces][:, [0, 1, 2, 0]], axis=1)).max()
    assert step < 0.4  # no tear


def test_shoulders_continue_the_neck(rig):
    bust = rig.template[rig.regions["bust"]]
    assert 0.34 < np.ptp(bust[:, 0]) < 0.48
    chin = rig.template[LANDMARKS[8], 1]
    assert 0.2 < chin - bust[:, 1].min() < 0.3
    assert (rig.skin_weights[rig.regions["bust"], 0] == 1).all()
    edges = np.linalg.norm(rig.template[rig.faces] - np.roll(rig.template[rig.faces], 1, 1), axis=-1)
    assert edges.max() < 0.05


def test_atlas_has_no_overlaps_and_shows_everything(rig, grid):
    a, b, c = (rig.uvs[rig.uv_faces[:, corner]].astype(np.float64) for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    assert (area >= 0).all()
    sizes = {}
    for region in ("face", "scalp", "eye_left", "eye_right", "teeth", "mouth", "bust"):
        sizes[region] = np.isin(grid.vertices, rig.regions[region]).all(1).sum()
    assert sizes["face"] > 6000 and sizes["scalp"] > 900 and sizes["bust"] > 2000
    assert min(sizes["eye_left"], sizes["eye_right"]) > 250 and sizes["teeth"] > 350 and sizes["mouth"] > 500
    assert len(grid) > 13000


def test_grid_triangles_are_sound(rig, grid):
    corner = (rig.template[grid.vertices] * grid.bary[..., None]).sum(1)[grid.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    edges = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=-1)
    assert area.min() > 1e-9 and edges.max() < 0.035 and 3e-3 < np.median(edges) < 7e-3


def test_lips_of_the_grid_part(rig, grid):
    """No grid triangle is stretched across the open mouth or the open eyes."""
    moved = posed(rig, jawOpen=1, mouthUpperUp_L=1, mouthUpperUp_R=1)
    corner = (moved[grid.vertices] * grid.bary[..., None]).sum(1)[grid.faces]
    edges = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=-1).max(1)
    face = np.isin(grid.vertices, rig.regions["face"]).all(1)[grid.faces].all(1)
    assert edges[face].max() < 0.03


def test_folder_with_some_files(rig, shared, caplog):
    with caplog.at_level(logging.WARNING):
        part = import_ict(shared / "ict" / "FaceXModel")
    assert part.expression_names == ("eyeBlink_L", "jawOpen", "mouthSmile_L") and part.n_identity == 2
    assert "50 of 53 expressions are missing" in caplog.text and "browDown_L" in caplog.text
    np.testing.assert_allclose(part.template, rig.template, atol=1e-7)
    np.testing.assert_array_equal(part.faces, rig.faces)
    jaw = [r.expression_basis[r.expression_names.index("jawOpen")] for r in (part, rig)]
    np.testing.assert_allclose(jaw[0], jaw[1], atol=2e-5)  # the packed file holds half precision


def test_broken_folders(tmp_path):
    with pytest.raises(DataError, match=r"generic_neutral_mesh\.obj"):
        import_ict(tmp_path)
    (tmp_path / "generic_neutral_mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    with pytest.raises(DataError, match=r"v: expected float\[26719, 3\], found float64\[3, 3\]"):
        import_ict(tmp_path)


def test_gap_in_identities(shared, tmp_path):
    for name in ("generic_neutral_mesh.obj", "vertex_indices.json", "jawOpen.obj"):
        (tmp_path / name).symlink_to(shared / "ict" / "FaceXModel" / name)
    (tmp_path / "identity001.obj").symlink_to(shared / "ict" / "FaceXModel" / "identity001.obj")
    with pytest.raises(DataError, match=r"identities: expected identity000\.obj before the next"):
        import_ict(tmp_path)
    (tmp_path / "identity001.obj").unlink()
    (tmp_path / "jawOpen.obj").unlink()
    with pytest.raises(DataError, match=r"expressions: expected an \.obj of one listed"):
        import_ict(tmp_path)


def test_broken_archive(shared, tmp_path):
    with np.load(shared / "ict" / "ict_facekit_light.npz") as arrays:
        content = dict(arrays)
    content["identity"] = content["identity"][:1]
    content["faces"] = content["faces"].copy()
    content["faces"][3, 1] = 26719
    np.savez(tmp_path / "bad.npz", **content)
    with pytest.raises(DataError, match="faces: expected indices 0 to 26718, found 26719"):
        import_ict(tmp_path / "bad.npz")
