"""People who do not exist: the same from the same number, where their parameters say, never half there."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cap4d import _core, cli
from cap4d.camera import opencv_from_rig
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError
from cap4d.mesh import rasterize_mesh
from cap4d.synth.body import draw_body
from cap4d.synth.capture import synthesize
from cap4d.synth.complexion import draw_complexion
from cap4d.synth.hair import grow_hair
from cap4d.synth.portrait import draw_person, draw_samples, pose_person

KIND = {"views": 3, "frames": 3, "size": 64}


@pytest.fixture(scope="module", autouse=True)
def sparse():
    """Few strands of hair and few shadows: they take most of the time of drawing a person."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cap4d.synth.portrait.grow_hair", partial(grow_hair, density=0.1))
        patch.setattr("cap4d.synth.light.SKY_DIRECTIONS", 16)
        patch.setattr("cap4d.synth.light.LIGHT_SAMPLES", 3)
        yield


@pytest.fixture(scope="module")
def capture(builtin_rig, tmp_path_factory) -> Capture:
    path = tmp_path_factory.mktemp("studio") / "capture"
    synthesize(builtin_rig, path, identity=5, seed=2, deviations=0.0, **KIND)
    return Capture.load(path)


@pytest.fixture(scope="module")
def person(builtin_rig):
    return draw_person(builtin_rig, 5, texels=256)


def test_layout(builtin_rig, capture):
    assert capture.rig_name == builtin_rig.name and len(capture) == 3 and len(capture.views) == 9
    assert capture.shape.std() > 0.3
    assert not capture.expr[0].any() and capture.expr[1:].any(1).all()
    for view in capture.views:
        image, matte = capture.image(view), capture.matte(view)
        assert image.shape == (64, 64, 3) and 0.2 < (matte > 0.5).mean() < 0.8
        assert image[matte > 0.99].std() > 0.05 and (image[matte == 0] == 1).all()


def test_parameters_reproject_onto_the_mattes(builtin_rig, capture):
    """What fit.npz says covers what the mattes cover; grown hair only adds to it."""
    subject = builtin_rig.subject(capture.shape)
    for view in capture.views[::2]:
        t = view.frame
        head = subject.pose(capture.expr[t], eye_rot=capture.eye_rot[t], neck_rot=capture.neck_rot[t])
        camera = capture.head_camera(view).resized(128, 128)
        hit = rasterize_mesh(opencv_from_rig(head.astype(np.float64)), builtin_rig.faces, camera).hit
        covered = hit.reshape(64, 2, 64, 2).mean((1, 3))
        assert (covered - capture.matte(view)).max() < 0.3  # a sample may flip on an edge
        assert np.abs(np.minimum(capture.matte(view) - covered, 0)).mean() < 1e-3


def test_same_numbers_same_bytes_and_others_differ(builtin_rig, capture, tmp_path):
    synthesize(builtin_rig, tmp_path / "again", identity=5, seed=2, deviations=0.0, **KIND)
    again = Capture.load(tmp_path / "again")
    for mine, theirs in zip(capture.views, again.views, strict=True):
        assert mine.image.read_bytes() == theirs.image.read_bytes()
    looks = [draw_complexion(np.random.default_rng([n, 1]), np.full(3, 0.02)) for n in range(40)]
    assert len({look.melanin for look in looks}) == 40
    assert min(look.melanin for look in looks) < 0.35 and max(look.melanin for look in looks) > 1.2


def test_a_mark_on_the_skin_is_seen_where_its_texel_projects(person):
    """A texel painted red shows red at the pixel that its triangle's middle projects to, and nowhere else."""
    head = opencv_from_rig(person.subject.neutral.astype(np.float64))
    camera = _front_camera(300)
    fragments = rasterize_mesh(head, person.rig.faces, camera)
    face = fragments.face[150, 150]
    x, y = person.uvs[person.rig.uv_faces[face]].mean(0).astype(int)
    texture = person.texture.copy()
    texture[y - 3 : y + 4, x - 3 : x + 4, :3] = [0.9, 0, 0]
    pose = pose_person(person, head)
    plain = draw_samples(person, pose, camera).rgb
    marked = draw_samples(replace(person, texture=texture), pose, camera).rgb
    changed = np.argwhere(np.abs(marked - plain).max(-1) > 0.05)
    middle = camera.project(head[person.rig.faces[face]].mean(0))[:2]
    assert np.abs(changed.mean(0)[::-1] + 0.5 - middle).max() < 6
    assert np.ptp(changed, axis=0).max() < 40
    red, green, _ = marked[150, 150]
    assert red > 5 * green


def test_depth_is_along_the_cameras_axis(person):
    camera = _front_camera(64)
    head = opencv_from_rig(person.subject.neutral.astype(np.float64))
    samples = draw_samples(person, pose_person(person, head), camera)
    seen = np.isfinite(samples.depth)
    np.testing.assert_array_equal(seen, samples.alpha > 0)
    fragments = rasterize_mesh(head, person.rig.faces, camera)
    expected = camera.project(fragments.interpolate(head, person.rig.faces)[seen])[:, 2]
    np.testing.assert_allclose(samples.depth[seen], expected, atol=1e-5)


def test_a_surface_seen_from_behind_is_dim_and_no_mirror(person):
    """The bowl of a mouth may be seen from its back; its normals point away there."""
    head, camera = opencv_from_rig(person.subject.neutral.astype(np.float64)), _front_camera(64)
    black = replace(person, texture=person.texture * np.float32([0, 0, 0, 1, 1, 1, 1, 1]))
    outside = pose_person(black, head)
    inside = replace(outside, normals=-outside.normals, soft=-outside.soft)
    rig = replace(person.rig, faces=person.rig.faces[:, ::-1], uv_faces=person.rig.uv_faces[:, ::-1])
    shine = draw_samples(black, outside, camera).rgb.mean()
    assert 0 < draw_samples(replace(black, rig=rig), inside, camera).rgb.mean() < 0.3 * shine


def test_deviations_vanish_at_rest_and_leave_the_eyes_alone(builtin_rig):
    subject = builtin_rig.subject()
    rest, expr = (
        np.zeros(builtin_rig.n_expressions, np.float32),
        np.full(builtin_rig.n_expressions, 0.4, np.float32),
    )
    turns = {"eye_rot": np.float32([0.1, 0.1, 0]), "neck_rot": np.float32([0, 0.1, 0])}
    own = draw_body(builtin_rig, subject, np.random.default_rng(1), 1.0)
    exact = draw_body(builtin_rig, subject, np.random.default_rng(1), 0.0)
    np.testing.assert_array_equal(own.pose(rest, **turns), subject.pose(rest, **turns))
    np.testing.assert_array_equal(exact.pose(expr, **turns), subject.pose(expr, **turns))
    moved = np.linalg.norm(own.pose(expr, **turns) - subject.pose(expr, **turns), axis=1)
    assert 1e-3 < moved.max() < 0.02
    assert moved[builtin_rig.regions["eyes"]].max() < 1e-6


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"identity": -1}, "identity"),
        ({"identity": 2**70}, "identity"),
        ({"views": 0}, "views"),
        ({"frames": 0}, "frames"),
        ({"size": 0}, "size"),
        ({"size": 10**6}, "size"),
        ({"seed": -1}, "seed"),
        ({"deviations": float("nan")}, "deviations"),
    ],
)
def test_refuses_numbers_out_of_range(builtin_rig, tmp_path, wrong, word):
    with pytest.raises(ArgumentError, match=word):
        synthesize(builtin_rig, tmp_path / "x", **{"identity": 1, **KIND, **wrong})
    assert not list(tmp_path.iterdir())


def test_a_folder_that_holds_something_is_left_alone(builtin_rig, tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(ArgumentError, match="exists already"):
        synthesize(builtin_rig, tmp_path, identity=1, **KIND)
    with pytest.raises(ArgumentError, match="does not exist"):
        synthesize(builtin_rig, tmp_path / "no" / "where", identity=1, **KIND)
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_an_interruption_leaves_nothing(builtin_rig, person, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("cap4d.synth.studio.draw_person", lambda *_, **__: person)
    monkeypatch.setattr("cap4d.synth.studio.picture", stop)
    with pytest.raises(KeyboardInterrupt):
        synthesize(builtin_rig, tmp_path / "x", identity=1, **KIND)
    assert not list(tmp_path.iterdir())


def test_a_rig_without_uvs_is_refused(builtin_rig, tmp_path):
    bare = replace(builtin_rig, uv_faces=builtin_rig.uv_faces[:0])
    with pytest.raises(ArgumentError, match="UVs"):
        synthesize(bare, tmp_path / "x", identity=1, **KIND)


def test_command_refuses_before_it_reads_the_rig(tmp_path, capsys):
    assert cli.main(["synth", "--rig", "none.npz", "--views", "0", "-o", str(tmp_path / "x")]) == 2
    assert "views" in capsys.readouterr().err
    assert cli.main(["synth", "--rig", "none.npz", "-o", str(tmp_path / "no" / "x")]) == 2


def test_noise_is_bounded_smooth_and_seeded():
    points = np.random.default_rng(0).uniform(-50, 50, (4000, 3)).astype(np.float32)
    value = _core.gradient_noise(points, 7)
    assert np.abs(value).max() < 1.2 and abs(value.mean()) < 0.03 and value.std() > 0.15
    assert np.abs(_core.gradient_noise(points + np.float32(1e-3), 7) - value).max() < 0.02
    assert np.abs(_core.gradient_noise(points, 8) - value).max() > 0.5
    distance, own = _core.cellular_noise(points, 7)
    assert distance.min() >= 0 and distance.max() < 1.8 and own.min() >= 0 and own.max() < 1
    assert _core.gradient_noise(np.float32([[np.inf, np.nan, 1e30]]), 1).shape == (1,)


@pytest.mark.parametrize("name", ["faces", "uv_faces", "face", "uvs"])
def test_light_surface_refuses_what_it_would_read_beyond(person, name, monkeypatch):
    head = opencv_from_rig(person.subject.neutral.astype(np.float64))
    true = _core.light_surface

    def spoiled(face, bary, faces, uv_faces, *rest):
        arrays = {"face": face, "faces": faces, "uv_faces": uv_faces, "uvs": rest[6]}
        arrays[name] = np.array(arrays[name])
        arrays[name].ravel()[0] = np.nan if name == "uvs" else 10**9
        return true(
            arrays["face"], bary, arrays["faces"], arrays["uv_faces"], *rest[:6], arrays["uvs"], *rest[7:]
        )

    monkeypatch.setattr(_core, "light_surface", spoiled)
    with pytest.raises(ValueError, match=name):
        draw_samples(person, pose_person(person, head), _front_camera(16))


def _front_camera(size: int):
    from cap4d.synth.studio import ring_of_cameras

    return ring_of_cameras(1, size, np.random.default_rng(0))["cam00"]
