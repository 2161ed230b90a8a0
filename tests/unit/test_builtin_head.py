"""The built-in head: a sound mesh, symmetric, human-like; its expressions do what their names say."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d.camera import opencv_from_rig, orbit_camera
from cap4d.mesh import shade
from cap4d.rig.builtin import build_head, build_mesh
from cap4d.rig.builtin.field import EYE, EYE_RADIUS
from cap4d.rig.builtin.skin import CORNER_COLUMN, OUTER_COLUMN, row_of
from cap4d.rig.grid import build_grid, remesh

MM = 1e3
PAIRS = (
    "browDown",
    "browOuterUp",
    "cheekSquint",
    "eyeBlink",
    "eyeLookDown",
    "eyeLookIn",
    "eyeLookOut",
    "eyeLookUp",
    "eyeSquint",
    "eyeWide",
    "jaw",
    "mouth",
    "mouthDimple",
    "mouthFrown",
    "mouthLowerDown",
    "mouthPress",
    "mouthSmile",
    "mouthStretch",
    "mouthUpperUp",
    "noseSneer",
)
SINGLE = (
    "browInnerUp",
    "cheekPuff",
    "jawForward",
    "jawOpen",
    "mouthClose",
    "mouthFunnel",
    "mouthPucker",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "tongueOut",
)
ARKIT = frozenset(SINGLE) | {name + side for name in PAIRS for side in ("Left", "Right")}


@pytest.fixture(scope="module")
def mesh():
    return build_mesh()


def weights(rig, **by_name: float) -> np.ndarray:
    expr = np.zeros(rig.n_expressions, np.float32)
    for name, value in by_name.items():
        expr[rig.expression_names.index(name)] = value
    return expr


def posed(rig, **by_name: float) -> np.ndarray:
    """[V, 3] mm"""
    return rig.subject().pose(weights(rig, **by_name)).astype(np.float64) * MM


def rim(mesh, key: str, column: int, *, left: bool = True) -> int:
    """The vertex of a lid's or lip's rim."""
    marks = mesh.marks
    at = mesh.of("skin") & (marks["row"] == row_of(key)) & (marks["column"] == column) & (marks["depth"] == 0)
    at &= mesh.points[:, 0] >= 0 if left else mesh.points[:, 0] < 0
    (vertex,) = np.flatnonzero(at)
    return vertex


def picture(rig, yaw: float, **by_name: float) -> np.ndarray:
    vertices = rig.subject().pose(weights(rig, **by_name)).astype(np.float64)
    view = {"distance": 1.2, "target": np.array([0, 0.02, 0]), "fov_y_deg": 18, "width": 384, "height": 384}
    camera = orbit_camera(yaw_deg=yaw, pitch_deg=0, **view)
    rgba = shade(opencv_from_rig(vertices), rig.faces, camera, colors=rig.colors, supersample=1)
    return ((rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]) * 255).astype(np.uint8)


def test_shapes_and_names(builtin_rig):
    rig = builtin_rig
    n = len(rig.template)
    assert 15_000 < n < 32_000
    assert rig.name == "builtin" and rig.licence == "Apache-2.0"
    assert set(rig.expression_names) == ARKIT and len(rig.expression_names) == 52
    assert rig.n_identity >= 10
    assert rig.identity_basis.shape == (rig.n_identity, n, 3)
    assert rig.joint_drivers == ("neck", "eyes", "eyes")
    assert rig.joints_identity.shape == (rig.n_identity, 3, 3)
    assert rig.skin_weights.shape == (n, 3) and rig.colors.shape == (n, 3)
    assert rig.colors.min() >= 0 and rig.colors.max() <= 1
    np.testing.assert_array_equal(rig.expression_range, [[0, 1]] * 52)
    wanted = {"head", "deformable", "eyes", "teeth", "mouth", "bust", "scalp", "hair", "lips"}
    assert wanted <= set(rig.regions)
    rigid = np.concatenate([rig.regions[k] for k in ("eyes", "teeth", "bust")])
    assert set(rig.regions["deformable"]) == set(range(n)) - set(rigid)


def test_the_same_bits_every_time(builtin_rig):
    again = build_head()
    for name in ("template", "faces", "uvs", "uv_faces", "identity_basis", "expression_basis", "colors"):
        np.testing.assert_array_equal(getattr(again, name), getattr(builtin_rig, name), err_msg=name)


def test_everything_is_finite_and_every_vertex_used(builtin_rig):
    rig = builtin_rig
    for name in ("template", "uvs", "identity_basis", "expression_basis", "joints", "skin_weights"):
        assert np.isfinite(getattr(rig, name)).all(), name
    assert len(np.unique(rig.faces)) == len(rig.template)
    corners = rig.template[rig.faces].astype(np.float64) * MM
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (area > 1e-6).mean() > 0.995  # mm^2; rows meet in points only at corners of eyes and mouth


def test_no_edge_has_more_than_two_triangles_and_neighbours_agree(builtin_rig):
    faces = builtin_rig.faces.astype(np.int64)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, counts = np.unique(directed[:, 0] * len(builtin_rig.template) + directed[:, 1], return_counts=True)
    assert counts.max() == 1  # each direction of an edge at most once: orientable, at most two triangles


def test_parts_face_outwards(builtin_rig, mesh):
    corners = mesh.points[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for name, centre, share in (
        ("skin", (0, 0, 0), 0.8),
        ("eye", EYE, 1),
        ("hair", (0, 40, -12), 0.97),
        ("shirt", (0, -260, -40), 0.9),
        ("tongue", (0, -60, 46), 0.95),
    ):
        mine = mesh.of(name)[mesh.faces[:, 0]] & (corners[:, :, 0].mean(1) > 0)
        outwards = ((corners[mine].mean(1) - centre) * normals[mine]).sum(1) > 0
        assert outwards.mean() >= share, name


def test_real_proportions(builtin_rig, mesh):
    skin = builtin_rig.template[mesh.of("skin")] * MM
    chin = skin[(np.abs(skin[:, 0]) < 3) & (skin[:, 2] > 60), 1].min()
    crown = builtin_rig.template[mesh.of("hair"), 1].max() * MM
    assert 215 < crown - chin < 265
    assert 125 < np.ptp(skin[(skin[:, 1] > -20) & (skin[:, 1] < 20), 0]) < 165
    assert 60 < np.ptp(builtin_rig.joints[1:, 0]) * MM < 70


def test_mirrored(builtin_rig, mesh):
    flip = np.array([-1, 1, 1])
    alike = ~mesh.of("hair")  # combed to one side
    mirrored = mesh.points[mesh.partner] * flip
    np.testing.assert_allclose(mirrored[alike], mesh.points[alike], atol=1e-9)
    names = builtin_rig.expression_names
    for i, name in enumerate(names):
        other = name.replace("Left", "Right") if "Left" in name else name.replace("Right", "Left")
        mine = builtin_rig.expression_basis[names.index(other)][mesh.partner] * flip
        np.testing.assert_allclose(mine, builtin_rig.expression_basis[i], atol=1e-8, err_msg=name)


def test_uvs_do_not_overlap_and_face_outwards(builtin_rig):
    rig = builtin_rig
    assert rig.uvs.min() >= 0 and rig.uvs.max() <= 1
    a, b, c = (rig.uvs[rig.uv_faces[:, k]].astype(np.float64) for k in range(3))
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert doubled.min() > -1e-9
    size = 1024  # each sample lies in as many triangles as the areas say only if none overlap
    hit = len(build_grid(rig, size))
    assert abs(0.5 * doubled.sum() * size**2 / hit - 1) < 2e-3


def test_the_grid_keeps_the_head_whole(builtin_rig, mesh):
    grid = build_grid(builtin_rig)
    assert len(grid) > 0.9 * 128**2
    edges = np.concatenate([grid.faces[:, [0, 1]], grid.faces[:, [1, 2]], grid.faces[:, [2, 0]]])
    edges = edges[
        (mesh.of("skin") & (mesh.points[:, 2] > 30) & (mesh.points[:, 1] > -80))[
            grid.vertices[edges[:, 0]]
        ].all(1)
    ]
    points = remesh(builtin_rig, grid).template * MM
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    assert np.median(length) < 3 and length.max() < 20  # dense on the face, nothing bridges eyes or lips
    face = (np.abs(points[:, 0]) < 55) & (np.abs(points[:, 1]) < 90) & (points[:, 2] > 40)
    assert face.mean() > 0.3  # most of the atlas is face
    subject = remesh(builtin_rig, grid).subject()
    ball = np.isin(grid.vertices, builtin_rig.regions["eyes"]).all(1)
    shut = subject.pose(weights(builtin_rig, eyeBlinkLeft=1, eyeBlinkRight=1)) * MM
    lids = shut[~ball & (np.linalg.norm(shut - EYE, axis=1) < EYE_RADIUS + 6) & (shut[:, 2] > EYE[2] + 10)]
    seen = shut[ball & (np.linalg.norm((shut - EYE)[:, :2], axis=1) < 9) & (shut[:, 2] > EYE[2])]
    nearest = np.linalg.norm(seen[:, None, :2] - lids[None, :, :2], axis=2).min(1)
    assert nearest.max() < 2.0  # the shut lids cover the front of the ball on the grid too


def test_eyeballs_only_turn(builtin_rig):
    ball = builtin_rig.regions["eyes"]
    assert not builtin_rig.expression_basis[:, ball].any()
    turned = builtin_rig.subject().pose(weights(builtin_rig), eye_rot=np.array([0.2, -0.3, 0], np.float32))
    moved = np.linalg.norm(turned - builtin_rig.template, axis=1) * MM
    assert moved[ball].max() > 3
    assert np.delete(moved, ball).max() == 0
    left = ball[builtin_rig.template[ball, 0] > 0]
    for points in (builtin_rig.template, turned):
        radius = np.linalg.norm(points[left] - builtin_rig.joints[1], axis=1) * MM
        np.testing.assert_allclose(radius, EYE_RADIUS, atol=0.5)


def test_identity_keeps_eyeballs_round_and_in_their_joints(builtin_rig):
    ball = builtin_rig.regions["eyes"]
    left = ball[builtin_rig.template[ball, 0] > 0]
    arm = builtin_rig.template[left] - builtin_rig.joints[1]
    for k in range(builtin_rig.n_identity):
        shape = np.zeros(builtin_rig.n_identity, np.float32)
        shape[k] = 2
        subject = builtin_rig.subject(shape)
        size = np.linalg.norm(subject.neutral[left] - subject.joints[1], axis=1) / np.linalg.norm(arm, axis=1)
        assert np.ptp(size) < 1e-3
        moved = np.linalg.norm(subject.neutral - builtin_rig.template, axis=1).max() * MM
        assert 2 < moved < 25, k


def test_neck_bends_under_a_fixed_head(builtin_rig, mesh):
    moved = builtin_rig.subject().pose(weights(builtin_rig), neck_rot=np.array([0.2, 0, 0], np.float32))
    moved = np.linalg.norm(moved - builtin_rig.template, axis=1) * MM
    assert moved[builtin_rig.regions["bust"]].min() > 5
    assert moved[mesh.of("hair", "ear", "eye", "teeth_upper")].max() == 0
    assert moved[mesh.of("skin") & (mesh.points[:, 1] > -60)].max() == 0


@pytest.mark.parametrize("name", sorted(ARKIT))
def test_each_expression_moves_its_own_part_by_a_natural_amount(builtin_rig, mesh, name):
    offsets = builtin_rig.expression_basis[builtin_rig.expression_names.index(name)].astype(np.float64) * MM
    size = np.linalg.norm(offsets, axis=1)
    low, high = {"eyeL": (0.6, 6), "jawO": (20, 45), "tong": (15, 45), "mout": (2, 20)}.get(
        name[:4], (1.5, 14)
    )
    assert low < size.max() < high
    assert not size[mesh.of("hair", "ear", "shirt", "eye", "teeth_upper")].any()
    y, share = mesh.points[:, 1], size**2 / (size**2).sum()
    if name.startswith(("eye", "brow")):
        assert share[y < 0].sum() < 0.1
    if name.startswith(("mouth", "jaw", "tongue")):
        assert share[y > -15].sum() < 0.1
    if name.endswith(("Left", "Right")) and name not in ("jawLeft", "jawRight", "mouthLeft", "mouthRight"):
        own = mesh.points[:, 0] > 0 if name.endswith("Left") else mesh.points[:, 0] < 0
        assert share[own].sum() > 0.85


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_blink_closes_the_eye_without_cutting_the_ball(builtin_rig, mesh, side):
    left = side == "Left"
    centre = EYE * [1 if left else -1, 1, 1]
    columns = range(CORNER_COLUMN + 1, OUTER_COLUMN)
    upper = [rim(mesh, "upper_lid", c, left=left) for c in columns]
    lower = [rim(mesh, "lower_lid", c, left=left) for c in columns]
    gap = np.linalg.norm(mesh.points[upper] - mesh.points[lower], axis=1)
    assert 9 < gap.max() < 15
    shut = posed(builtin_rig, **{f"eyeBlink{side}": 1})
    assert np.linalg.norm(shut[upper] - shut[lower], axis=1).max() < 1.0
    marks = mesh.marks
    lids = mesh.of("skin") & (marks["depth"] == 0) & (np.linalg.norm(mesh.points - centre, axis=1) < 24)
    for amount in (0.0, 0.25, 0.5, 0.75, 1.0):
        points = posed(builtin_rig, **{f"eyeBlink{side}": amount})[lids]
        assert np.linalg.norm(points - centre, axis=1).min() > EYE_RADIUS + 0.3
    other = rim(mesh, "upper_lid", 27, left=not left)
    assert np.linalg.norm(shut[other] - mesh.points[other]) < 1e-3


def test_jaw_opens_the_mouth_and_close_shuts_it_again(builtin_rig, mesh):
    upper, lower = rim(mesh, "upper_lip", 0), rim(mesh, "lower_lip", 0)
    rest, opened = posed(builtin_rig), posed(builtin_rig, jawOpen=1)
    assert rest[upper, 1] - rest[lower, 1] == pytest.approx(0, abs=0.1)
    assert 20 < opened[upper, 1] - opened[lower, 1] < 40
    teeth = mesh.of("teeth_lower")
    assert (rest[teeth, 1] - opened[teeth, 1]).mean() > 12
    both = posed(builtin_rig, jawOpen=1, mouthClose=1)
    for column in range(CORNER_COLUMN):
        a, b = rim(mesh, "upper_lip", column), rim(mesh, "lower_lip", column)
        assert np.linalg.norm(both[a] - both[b]) < 1.5


def test_the_mouths_lining_hangs_on_the_lips(builtin_rig, mesh):
    """The pouch starts where the skin behind the lips ends, whatever the expression."""
    row = mesh.marks["row"]
    ends = np.flatnonzero(mesh.of("mouth") & ((row == 0) | (row == 1)))
    inner = np.flatnonzero(mesh.of("skin") & (mesh.marks["depth"] == 4))
    rng = np.random.default_rng(0)
    for _ in range(3):
        points = builtin_rig.subject().pose(rng.uniform(0, 1, 52).astype(np.float32)).astype(np.float64) * MM
        away = np.linalg.norm(points[ends, None] - points[None, inner], axis=2).min(1)
        assert away.max() < 1e-3


def test_names_mean_what_they_say(builtin_rig, mesh):
    corner = rim(mesh, "upper_lip", CORNER_COLUMN)
    upper, lower = rim(mesh, "upper_lip", 6), rim(mesh, "lower_lip", 6)
    brow = np.argmin(np.linalg.norm(mesh.points - [20, 42, 78], axis=1))
    cheek = np.argmin(np.linalg.norm(mesh.points - [40, -45, 55], axis=1))
    tip = np.flatnonzero(mesh.of("tongue"))[np.argmax(mesh.marks["tip"][mesh.of("tongue")])]
    lid = rim(mesh, "upper_lid", 27)
    for name, vertex, direction, least in (
        ("mouthSmileLeft", corner, (0.6, 0.8, 0), 5),
        ("mouthFrownLeft", corner, (0, -1, 0), 4),
        ("mouthStretchLeft", corner, (1, 0, 0), 5),
        ("mouthPucker", corner, (-1, 0, 0), 5),
        ("mouthLeft", corner, (1, 0, 0), 5),
        ("mouthUpperUpLeft", upper, (0, 1, 0), 4),
        ("mouthLowerDownLeft", lower, (0, -1, 0), 4),
        ("mouthRollLower", lower, (0, 0, -1), 3),
        ("mouthRollUpper", upper, (0, 0, -1), 3),
        ("browInnerUp", brow, (0, 1, 0), 3),
        ("browDownLeft", brow, (0, -1, 0), 3),
        ("cheekPuff", cheek, (0.7, 0, 0.7), 5),
        ("tongueOut", tip, (0, -0.3, 1), 20),
        ("eyeWideLeft", lid, (0, 1, 0), 1.5),
        ("eyeLookDownLeft", lid, (0, -1, 0), 2.5),
        ("eyeLookUpLeft", lid, (0, 1, 0), 1),
    ):
        offset = posed(builtin_rig, **{name: 1})[vertex] - mesh.points[vertex]
        assert offset @ direction > least, name


@pytest.mark.parametrize(
    ("yaw", "expression"),
    [(0, {}), (-30, {}), (30, {}), (0, {"jawOpen": 0.7}), (0, {"eyeBlinkLeft": 1, "eyeBlinkRight": 1})],
)
def test_mediapipe_sees_a_face(builtin_rig, yaw, expression):
    solutions = pytest.importorskip("mediapipe", reason="needs MediaPipe").solutions
    with solutions.face_mesh.FaceMesh(static_image_mode=True, min_detection_confidence=0.5) as detector:
        found = detector.process(picture(builtin_rig, yaw, **expression)).multi_face_landmarks
    assert found is not None and len(found) == 1
