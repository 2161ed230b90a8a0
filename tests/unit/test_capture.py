"""A capture comes back as it was saved, released folders load as they stand, malformed ones are named."""

import json
import zipfile

import numpy as np
import pytest

from cap4d.camera import Camera
from cap4d.errors import ArgumentError, DataError

pytest.importorskip("OpenImageIO", reason="needs the extra [capture]")

from cap4d.capture.capture import Capture, View, save_capture
from cap4d.capture.image import write_image

T, E, S, WIDTH, HEIGHT = 3, 4, 2, 8, 6


def _camera(focal=20.0):
    viewmat = np.eye(4)
    viewmat[2, 3] = 0.25
    return Camera(np.array([[focal, 0, 4], [0, focal, 3], [0, 0, 1.0]]), viewmat, WIDTH, HEIGHT)


def _arrays(seed=0):
    rng = np.random.default_rng(seed)
    poses = {name: rng.normal(size=(T, 3)) for name in ("rot", "tra", "eye_rot", "neck_rot", "jaw_rot")}
    return dict(shape=rng.normal(size=S), expr=rng.random((T, E)), **poses)


@pytest.fixture
def saved(tmp_path):
    (tmp_path / "images" / "cam0").mkdir(parents=True)
    (tmp_path / "bg" / "cam0").mkdir(parents=True)
    for t in range(T):
        write_image(tmp_path / f"images/cam0/{t:05d}.png", np.full((HEIGHT, WIDTH, 3), t / 4))
    write_image(tmp_path / "bg/cam0/0001.png", np.full((HEIGHT, WIDTH), 0.2))
    held_out = np.array([False, True, False])
    save_capture(
        tmp_path, rig_name="some", cameras={"cam0": _camera()}, fps=25, held_out=held_out, **_arrays()
    )
    return tmp_path


def _rewrite(folder, **changes):
    with np.load(folder / "fit.npz") as archive:
        arrays = dict(archive)
    arrays |= changes
    np.savez(folder / "fit.npz", **{name: value for name, value in arrays.items() if value is not None})


def test_round_trip(saved):
    capture = Capture.load(saved)
    for name, value in _arrays().items():
        np.testing.assert_array_equal(getattr(capture, name), value.astype(np.float32))
    assert (capture.rig_name, capture.fps, len(capture)) == ("some", 25.0, T)
    assert capture.held_out.tolist() == [False, True, False]
    assert [view.frame for view in capture.views] == [0, 1, 2]
    np.testing.assert_allclose(capture.camera(capture.views[0]).K, _camera().K)


def test_images_are_composited_on_white_with_their_matte(saved):
    capture = Capture.load(saved)
    np.testing.assert_allclose(capture.image(capture.views[2]), 0.5, atol=0.5 / 255)
    np.testing.assert_allclose(capture.image(capture.views[1]), 0.25 * 0.2 + 0.8, atol=1 / 255)
    assert capture.matte(capture.views[2]) is None


def test_head_camera_sees_the_head_where_the_camera_saw_it_move(saved):
    from cap4d.camera import opencv_from_rig
    from cap4d.rotation import axis_angle_to_rotmat

    capture = Capture.load(saved)
    view = capture.views[1]
    point = np.array([[0.01, 0.02, 0.03]])
    world = point @ axis_angle_to_rotmat(capture.rot[1].astype(float)).T + capture.tra[1]
    expected = capture.camera(view).project(opencv_from_rig(world))
    np.testing.assert_allclose(capture.head_camera(view).project(opencv_from_rig(point)), expected, rtol=1e-5)


def test_clip_carries_poses_and_rig(saved):
    clip = Capture.load(saved).clip()
    assert (clip.rig_name, clip.fps) == ("some", 25.0)
    np.testing.assert_array_equal(clip.neck_rot, _arrays()["neck_rot"].astype(np.float32))


def test_invalid_frames_are_no_views_and_a_listing_decides(saved):
    _rewrite(saved, valid_mask=np.array([[True, False, True]]))
    assert [view.frame for view in Capture.load(saved).views] == [0, 2]
    (saved / "reference_images.json").write_text(json.dumps([["cam0", 1]]))
    views = Capture.load(saved).views
    assert views == (View("cam0", 1, saved / "images/cam0/00001.png", saved / "bg/cam0/0001.png"),)


def test_a_camera_with_one_photo_of_many_is_found_by_its_number(saved):
    for t in (0, 1):
        (saved / f"images/cam0/{t:05d}.png").unlink()
    assert [view.frame for view in Capture.load(saved).views] == [2]


def test_neck_and_jaw_may_be_missing(saved):
    _rewrite(saved, neck_rot=None, jaw_rot=None, held_out=None, rig_name=None)
    capture = Capture.load(saved)
    assert not capture.neck_rot.any() and capture.jaw_rot.shape == (T, 3) and capture.held_out is None
    assert capture.clip().rig_name == "flame2023_no_jaw"


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("expr", dict(expr=np.zeros((0, E)))),
        ("expr", dict(expr=np.zeros(E))),
        ("expr", dict(expr=np.full((T, E), np.nan))),
        ("rot", dict(rot=np.zeros((T + 1, 3)))),
        ("tra", dict(tra=None)),
        ("eye_rot", dict(eye_rot=np.full((T, 3), np.inf))),
        ("neck_rot", dict(neck_rot=np.zeros((T, 4)))),
        ("shape", dict(shape=np.array(["a", "b"]))),
        ("extr", dict(extr=np.eye(4)[None, :3])),
        ("fx", dict(fx=np.array([[-1.0]]), fy=np.array([[1.0]]))),
        ("resolutions", dict(resolutions=np.array([[0, 8]]))),
        ("resolutions", dict(resolutions=np.array([[10**9, 8]]))),
        ("camera_order", dict(camera_order=np.array(["../cam0"]))),
        ("camera_order", dict(camera_order=np.array([".."]))),
        ("camera_order", dict(camera_order=np.array(["/etc"]))),
        ("camera_order", dict(camera_order=np.array([0]))),
        ("valid_mask", dict(valid_mask=np.ones((1, T + 1), bool))),
        ("held_out", dict(held_out=np.zeros(T))),
        ("fps", dict(fps=np.float64(0))),
        ("rig_name", dict(rig_name=np.array(3))),
        ("shape", dict(shape=np.array([{}], object))),
        ("expr", dict(expr=np.full((T, E), 1e300))),
        (r"extr\[0\]", dict(extr=np.zeros((1, 4, 4)))),
        (r"extr\[0\]", dict(extr=np.diag([-1.0, 1, 1, 1])[None])),
        ("fx", dict(fx=np.array([[0.0]]))),
    ],
)
def test_malformed_fit_is_named(saved, field, changes):
    _rewrite(saved, **changes)
    with pytest.raises(DataError, match=rf"fit\.npz: .*{field}") as caught:
        Capture.load(saved)
    assert "\n" not in str(caught.value)


def test_what_nobody_asked_for_is_not_unpacked(saved):
    _rewrite(saved, notes=np.array([{}], object))
    assert len(Capture.load(saved)) == T


def test_a_bomb_is_refused_before_it_is_unpacked(saved):
    _rewrite(saved, held_out=None)
    with zipfile.ZipFile(saved / "fit.npz", "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("held_out.npy", bytes(1000))
    data = bytearray((saved / "fit.npz").read_bytes())
    at = data.rindex(b"PK\x01\x02")
    data[at + 24 : at + 28] = ((1 << 29) + 1).to_bytes(4, "little")
    (saved / "fit.npz").write_bytes(data)
    with pytest.raises(DataError, match="size: expected at most"):
        Capture.load(saved)


@pytest.mark.parametrize(
    "listing", ["[", "{}", '[["cam0", 3]]', '[["cam0", -1]]', '[["../cam0", 0]]', '[["cam0", true]]', "[[]]"]
)
def test_malformed_listing_is_named(saved, listing):
    (saved / "reference_images.json").write_text(listing)
    with pytest.raises(DataError, match=r"reference_images\.json"):
        Capture.load(saved)


def test_missing_and_truncated_archives_are_named(saved):
    data = (saved / "fit.npz").read_bytes()
    for cut in (0, 10, len(data) // 2, len(data) - 30):
        (saved / "fit.npz").write_bytes(data[:cut])
        with pytest.raises(DataError, match=r"fit\.npz"):
            Capture.load(saved)
    np.save(saved / "array.npy", np.zeros(3))
    (saved / "array.npy").rename(saved / "fit.npz")
    with pytest.raises(DataError, match="archive"):
        Capture.load(saved)
    (saved / "fit.npz").unlink()
    with pytest.raises(DataError, match="no such file"):
        Capture.load(saved)


def test_missing_or_wrong_images_are_named(saved):
    write_image(saved / "images/cam0/00000.png", np.zeros((HEIGHT, WIDTH + 1, 3)))
    capture = Capture.load(saved)
    with pytest.raises(DataError, match=r"00000\.png: size: expected 8x6 .* found 9x6"):
        capture.image(capture.views[0])
    for image in (saved / "images/cam0").iterdir():
        image.unlink()
    with pytest.raises(DataError, match="images"):
        Capture.load(saved)


def test_saving_refuses_what_loading_would(tmp_path):
    arrays = _arrays() | dict(rot=np.zeros((T, 2)))
    with pytest.raises(ArgumentError, match="rot"):
        save_capture(tmp_path / "new", rig_name="some", cameras={"cam0": _camera()}, **arrays)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["tesla", "lincoln"])
def test_released_reference_folders_load_as_they_stand(shared, name):
    capture = Capture.load(shared / "photos" / name)
    (view,) = capture.views
    image, camera = capture.image(view), capture.camera(view)
    assert image.shape == (camera.height, camera.width, 3) and capture.expr.shape == (1, 65)
    assert (capture.matte(view) is None) == (name == "lincoln")
    x, y, depth = capture.head_camera(view).project(np.zeros(3))
    assert 0 < x < camera.width and 0 < y < camera.height and 1 < depth < 1.5
