"""FLAME as a rig against a direct evaluation of facts 6-13 that shares no code with it; refusals; real fits
on photos.
"""

from __future__ import annotations

import pickle
import shutil

import numpy as np
import pytest

from cap4d.camera import Camera, opencv_from_rig
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.flame import BLINK, half_sphere, import_flame
from cap4d.rig.grid import build_grid
from cap4d.rig.unpickle import read_pickle
from cap4d.rotation import axis_angle_to_rotmat

MODEL, ASSETS = "flame/flame_standin.pkl", "flame/cap4d_assets"


@pytest.fixture(scope="module")
def rig(shared):
    return import_flame(shared / MODEL, shared / ASSETS)


@pytest.fixture(scope="module")
def content(shared):
    return read_pickle(shared / MODEL)


def rodrigues(vector):
    angle = np.sqrt(max(vector @ vector, 1e-8))  # fact 9
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def evaluate(content, folder, *, shape, expr, eye_rot, neck_rot, jaw_rot):
    """[5423, 3] float64: facts 4-13 read one after the other."""
    basis = content["shapedirs"].astype(np.float64)
    expression = basis[:, :, 300:365].copy()
    expression[:, :, 64] = np.load(folder / "blink_blendshape.npy")
    shaped = content["v_template"] + basis[:, :, :150] @ shape
    vertices = shaped + expression @ expr
    joints = content["J_regressor"] @ vertices
    rotations = {0: rodrigues(neck_rot), 2: rodrigues(jaw_rot), 3: rodrigues(eye_rot), 4: rodrigues(eye_rot)}
    feature = np.concatenate([(rotations[j] - 2 * np.eye(3)).ravel() for j in (0, 2, 3, 4)])
    vertices = vertices + content["posedirs"] @ feature
    posed = 0
    for j in range(5):
        turn = rotations.get(j, np.eye(3))
        posed = posed + content["weights"][:, j, None] * ((vertices - joints[j]) @ turn.T + joints[j])

    jaw, lip = (content["J_regressor"] @ shaped)[2], shaped[3533]
    distance = np.linalg.norm(lip - jaw)
    z = (lip - jaw) / distance
    x = np.cross([0, 1, 0], z)
    x /= np.linalg.norm(x)
    centre = jaw + 0.75 * (lip - jaw) - 0.005 * z
    frame = np.stack([x, np.cross(z, x), z])
    sphere = []
    for i in range(10):
        latitude = np.radians(-90 + 180 / 19 * i)
        for longitude in np.linspace(0, 2 * np.pi, 20):
            ring = np.cos(latitude)
            sphere.append([ring * np.cos(longitude), -ring * np.sin(longitude), -np.sin(latitude)])
    upper = np.array(sphere) @ frame * 0.25 * distance + centre
    lower = (upper - jaw) @ rodrigues(expr @ np.load(folder / "jaw_regressor.npy")).T + jaw
    return np.concatenate([posed, upper, lower])


@pytest.mark.parametrize("seed", range(3))
def test_same_as_a_direct_evaluation(rig, content, shared, seed):
    rng = np.random.default_rng(seed)
    shape, expr = rng.normal(size=150), rng.normal(size=65)
    turns = {name: 0.4 * rng.normal(size=3) for name in ("eye_rot", "neck_rot", "jaw_rot")}
    expected = evaluate(content, shared / ASSETS, shape=shape, expr=expr, **turns)
    found = rig.map(lambda a: a.astype(np.float64)).subject(shape).pose(expr, **turns)
    np.testing.assert_allclose(found, expected, atol=3e-7)  # the rig's arrays are float32
    single = rig.subject(shape.astype(np.float32)).pose(
        expr.astype(np.float32), **{name: turn.astype(np.float32) for name, turn in turns.items()}
    )
    np.testing.assert_allclose(single, expected, atol=2e-6)


def test_constant_pose_offset_of_fact_8(rig, content, shared):
    """It is there or not at the switch, is -(the 12 diagonal correctives), and cancels in differences."""
    plain = import_flame(shared / MODEL, shared / ASSETS, compat_pose_offset=False)
    diagonal = content["posedirs"][:, :, [9 * j + k for j in range(4) for k in (0, 4, 8)]].sum(-1)
    expr = np.random.default_rng(0).normal(size=65).astype(np.float32)
    constant = rig.subject().pose(expr) - plain.subject().pose(expr)
    np.testing.assert_allclose(constant[:5023], -diagonal, atol=1e-7)
    assert np.abs(constant[:5023]).max() > 1e-4 and np.abs(constant[5023:]).max() == 0
    moved = [r.subject().pose(expr) - r.subject().pose(0 * expr) for r in (rig, plain)]
    np.testing.assert_allclose(*moved, atol=1e-7)


def test_counts(rig):
    assert len(rig.template) == 5423 and len(rig.faces) == 10656 and len(rig.uvs) == 5462  # fact 14
    assert (rig.n_identity, rig.n_expressions, rig.expression_names[BLINK]) == (150, 65, "blink")
    assert rig.name == "flame2023_no_jaw"  # by what it is, not by its file's name
    assert (len(rig.regions["head"]), len(rig.regions["deformable"])) == (4783, 4922)  # fact 15
    grid = build_grid(rig)
    assert (len(grid), len(grid.faces), grid.deformable.sum()) == (14425, 28120, 8424)


def test_blink_of_fact_4(rig):
    moved = np.linalg.norm(rig.expression_basis[BLINK], axis=1)
    assert (moved > 1e-4).sum() == 694 and abs(moved.max() - 10.24e-3) < 1e-5


def test_template_mouth_is_the_half_sphere(shared):
    """The template's upper bowl is the half-sphere of fact 12 up to a similarity, vertex by vertex."""
    from cap4d.rig.obj import read_obj

    bowl = read_obj(shared / ASSETS / "cap4d_avatar_template.obj").vertices[5023:5223]
    ours = half_sphere()
    a, b = bowl - bowl.mean(0), ours - ours.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    assert np.linalg.det(u @ vt) > 0
    np.testing.assert_allclose(b @ (u @ vt) * (s.sum() / (b * b).sum()), a, atol=2e-6)


def test_jaw_of_fact_13(rig, shared):
    expr = np.load(shared / ASSETS / "gen_data.npz")["expr"]
    angle = np.degrees((expr @ rig.expr_rotation)[:, 0])
    assert abs(angle.min() + 5.9) < 0.1 and abs(angle.max() - 26.4) < 0.1
    opened = rig.subject().pose(np.float32([2] + [0] * 64)) - rig.subject().pose(np.zeros(65, np.float32))
    assert opened[5223:, 1].min() < -1e-3 and np.abs(opened[5023:5223]).max() == 0


def test_editions_with_a_jaw_turn_the_lower_mouth_with_it(shared, tmp_path):
    (tmp_path / "generic_model.pkl").symlink_to(shared / MODEL)
    rig = import_flame(tmp_path / "generic_model.pkl", shared / ASSETS)
    assert rig.name == "flame2020"
    rest = np.zeros(65, np.float32)
    moved = rig.subject().pose(rest, jaw_rot=np.float32([0.3, 0, 0])) - rig.subject().pose(rest)
    assert moved[5223:, 1].min() < -3e-3 and np.abs(moved[5023:5223]).max() == 0
    by_expression = rig.subject().pose(np.float32([2] + [0] * 64)) - rig.subject().pose(rest)
    assert np.abs(by_expression[5223:]).max() < 1e-7


def test_without_assets(shared):
    bare = import_flame(shared / MODEL)
    assert (len(bare.template), bare.n_expressions, bare.mouth, len(bare.uvs)) == (5023, 100, None, 0)
    with pytest.raises(ArgumentError, match="--assets"):
        build_grid(bare)


@pytest.mark.parametrize(("photo", "median", "face"), [("tesla", 3.0, 2.0), ("lincoln", 2.0, 1.5)])
def test_fits_project_onto_the_photos(rig, shared, photo, median, face):
    """Median distance in pixels to the dense alignment: of all vertices, and of those the tracker weighs."""
    fit = np.load(shared / "photos" / photo / "fit.npz")
    seen = np.load(shared / "photos" / photo / "alignment.npz")["vertex_coords"].reshape(5023, 2)
    height, width = (int(n) for n in fit["resolutions"][0])
    fx, fy, cx, cy = (fit[name][0, 0] for name in ("fx", "fy", "cx", "cy"))
    camera = Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), fit["extr"][0], width, height)
    head = rig.subject(fit["shape"]).pose(fit["expr"][0], eye_rot=fit["eye_rot"][0])
    world = head @ axis_angle_to_rotmat(fit["rot"][0]).T + fit["tra"][0]
    error = np.linalg.norm(camera.project(opencv_from_rig(world))[:5023, :2] - seen, axis=1)
    on_face = np.load(shared / ASSETS / "flowface_vertex_mask.npy")
    print(f"{photo}: {np.median(error):.2f} px, face {np.median(error[on_face]):.2f} px at {width}x{height}")
    assert np.median(error) < median and np.median(error[on_face]) < face


DAMAGE = {
    "weights": (lambda a: a[:, :4], r"weights: expected float\[5023, 5\], found float64\[5023, 4\]"),
    "J_regressor": (lambda a: np.full((5, 5023), np.inf), "J_regressor: expected finite values"),
    "f": (lambda a: np.where(a == 7, 5023, a), "f: expected indices 0 to 5022, found 5023"),
    "shapedirs": (lambda a: a[:, :, :100], "shapedirs: expected at least 365 components, found 100"),
    "v_template": (lambda a: None, r"v_template: expected float\[5023, 3\], found nothing"),
    "posedirs": (lambda a: a.astype(int), "posedirs: expected float"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_model(content, tmp_path, name):
    change, message = DAMAGE[name]
    path = tmp_path / "flame2023.pkl"
    changed = change(np.asarray(content[name]))
    rest = {key: value for key, value in content.items() if key != name}
    path.write_bytes(pickle.dumps(rest if changed is None else {**rest, name: changed}))
    with pytest.raises(DataError, match=message) as caught:
        import_flame(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["blink_blendshape.npy", "cap4d_avatar_template.obj", "head_vertices.txt"])
def test_damaged_assets(shared, tmp_path, name):
    folder = shutil.copytree(shared / ASSETS, tmp_path / "assets")
    (folder / name).chmod(0o644)
    (folder / name).write_bytes(b"f 1 2 3\n")
    with pytest.raises(DataError, match=name):
        import_flame(shared / MODEL, folder)
    (folder / name).unlink()
    with pytest.raises(DataError, match=name):
        import_flame(shared / MODEL, folder)
