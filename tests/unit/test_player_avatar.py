"""The avatar as a program uses it: what it takes, what it refuses, what it gives."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle, tiny_bundle_on_mesh

import cap4d
from cap4d.bundle import Bundle, write_bundle
from cap4d.errors import ArgumentError, DataError
from cap4d.player.avatar import Avatar

ZERO = np.zeros(len(EXPRESSIONS), np.float32)
OPEN = np.float32([1, 0, 0, 0, 0])


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return tiny_bundle()


@pytest.fixture
def avatar(bundle: Bundle) -> Avatar:
    return Avatar(bundle)


def test_load(bundle: Bundle, tmp_path: Path) -> None:
    write_bundle(bundle, tmp_path / "a.cap4d")
    avatar = cap4d.Avatar.load(tmp_path / "a.cap4d")
    assert avatar.rig_name == RIG_NAME
    assert np.array_equal(avatar.camera.viewmat, bundle.camera.viewmat)
    assert np.array_equal(avatar.idle.expr, bundle.idle.expr)
    assert np.array_equal(avatar.vertices(OPEN), Avatar(bundle).vertices(OPEN))


def test_load_of_no_file() -> None:
    with pytest.raises(DataError, match="no such file"):
        cap4d.Avatar.load("nowhere.cap4d")


def test_playing_imports_no_torch(bundle: Bundle, tmp_path: Path) -> None:
    write_bundle(bundle, tmp_path / "a.cap4d")
    code = f"""
import sys, cap4d
from cap4d.player.offline import render_file
render_file({str(tmp_path / "a.cap4d")!r}, {str(tmp_path / "a.mp4")!r}, size="32x32", frames=2)
print([m for m in ("torch", "onnx", "scipy", "trimesh", "OpenImageIO", "pickle5") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_neutral_is_the_rig_with_its_correction(avatar: Avatar, bundle: Bundle) -> None:
    expected = bundle.subject.pose(ZERO) * np.float32([1, -1, -1]) + bundle.deform_neutral
    np.testing.assert_allclose(avatar.vertices(ZERO), expected, atol=1e-7)


def test_the_network_moves_only_what_is_deformable(avatar: Avatar, bundle: Bundle) -> None:
    still = Avatar(bundle, deformer="off")
    moved = np.abs(avatar.vertices(OPEN) - still.vertices(OPEN)).max(1)
    assert moved[~bundle.grid.deformable].max() == 0
    assert moved[bundle.grid.deformable].max() > 1e-4


def test_an_avatar_without_a_network_plays(bundle: Bundle) -> None:
    bare = Avatar(replace(bundle, deform_onnx=None))
    assert np.array_equal(bare.vertices(OPEN), Avatar(bundle, deformer="off").vertices(OPEN))


def test_an_avatar_on_the_rigs_own_triangles_plays() -> None:
    bundle = tiny_bundle_on_mesh()
    avatar, frame = Avatar(bundle), bundle.idle.frame(5)
    turns = {"eye_rot": frame.eye_rot, "neck_rot": frame.neck_rot}
    expected = bundle.subject.pose(frame.expr, **turns) * np.float32([1, -1, -1])
    np.testing.assert_allclose(avatar.vertices(frame.expr, **turns), expected, atol=1e-7)
    assert avatar.tier == "off" and not avatar.deformation().any()
    assert np.ptp(avatar.render(frame.expr, **turns)[..., 3]) == 255
    with pytest.raises(ArgumentError, match="deformer: expected one that avatar has"):
        Avatar(bundle, deformer="full")


def test_the_neck_bends_under_a_face_that_the_network_sees_unbent(avatar: Avatar, bundle: Bundle) -> None:
    neck = np.float32([0.2, 0.1, 0])
    avatar.vertices(OPEN)
    straight = avatar.deformer.passes
    bent = avatar.vertices(OPEN, neck_rot=neck)
    assert avatar.deformer.passes == straight, "the network's input must not depend on the neck"
    weight = bundle.subject.skin_weights[:, 0]
    change = np.abs(bent - avatar.vertices(OPEN)).max(1)
    assert change[weight > 0.1].min() > 1e-4


def test_an_unchanged_expression_costs_no_pass(avatar: Avatar) -> None:
    for expr, passes in ((ZERO, 1), (ZERO, 1), (OPEN, 2), (OPEN, 2), (ZERO, 3)):
        avatar.vertices(expr)
        assert avatar.deformer.passes == passes


def test_a_changed_array_in_place_is_a_changed_expression(avatar: Avatar) -> None:
    expr = ZERO.copy()
    before = avatar.vertices(expr)
    expr[0] = 1
    assert np.abs(avatar.vertices(expr) - before).max() > 1e-4


def test_zero_rotations_are_no_rotations(avatar: Avatar) -> None:
    zero = np.zeros(3)
    assert np.array_equal(
        avatar.vertices(OPEN), avatar.vertices(OPEN, eye_rot=zero, neck_rot=zero, jaw_rot=zero)
    )


def test_pose_gives_float32_gaussians(avatar: Avatar, bundle: Bundle) -> None:
    gaussians = avatar.pose(OPEN, eye_rot=[0.1, 0, 0])
    assert len(gaussians) == len(bundle) and gaussians.sh_degree == 1
    np.testing.assert_allclose(gaussians.opacities, 1 / (1 + np.exp(-bundle.opacity_logits)), atol=1e-6)


def test_render_with_and_without_a_background(avatar: Avatar) -> None:
    clear = avatar.render(OPEN)
    white, black = (avatar.render(OPEN, background=(c, c, c)) for c in (1.0, 0.0))
    assert clear.shape == white.shape == (64, 64, 4) and clear.dtype == np.uint8
    assert white[0, 0].tolist() == [255, 255, 255, 255] and black[0, 0].tolist() == [0, 0, 0, 255]
    assert clear[0, 0, 3] == 0 and clear[32, 32, 3] > 250
    # Straight alpha over white is the picture on white.
    alpha = clear[..., 3:] / 255
    over = clear[..., :3] * alpha + 255 * (1 - alpha)
    seen = clear[..., 3] > 32
    assert np.abs(over - white[..., :3])[seen].max() <= 2.5


def test_render_takes_any_camera(avatar: Avatar) -> None:
    assert avatar.render(ZERO, avatar.camera.resized(40, 24)).shape == (24, 40, 4)


def test_stages_are_timed(avatar: Avatar) -> None:
    avatar.render(ZERO)
    parts = ["project", "sort", "tiles", "rasterize"]  # of `splat`, which also writes the 8-bit pixels
    assert list(avatar.stages.report()) == ["rig", "deform", "bind", "splat", *parts]


@pytest.mark.parametrize(
    ("expr", "found"),
    [
        (np.zeros(4), r"got float64\[4\]"),
        (np.zeros((1, 5)), r"got float64\[1, 5\]"),
        (np.array(["a"] * 5), "got <U1"),
        (np.array([0, 0, np.nan, 0, 0]), "not"),
        (np.array([0, 0, 1e39, 0, 0]), "not"),
    ],
    ids=["length", "rank", "text", "nan", "overflow"],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_wrong_expressions_are_refused(expr: np.ndarray, found: str, avatar: Avatar) -> None:
    with pytest.raises(ArgumentError, match=rf"expr: expected 5 .*\(tiny\), .*{found}"):
        avatar.pose(expr)


@pytest.mark.parametrize("value", [[1, 2], [0, np.inf, 0]])
@pytest.mark.parametrize("name", ["eye_rot", "neck_rot", "jaw_rot"])
def test_wrong_rotations_are_refused(name: str, value: list, avatar: Avatar) -> None:
    with pytest.raises(ArgumentError, match=f"{name}: expected 3"):
        avatar.vertices(ZERO, **{name: value})


def test_frames_of_another_rig_are_refused(avatar: Avatar) -> None:
    frame = replace(avatar.idle.frame(0), rig_name="flame2023_no_jaw")
    with pytest.raises(ArgumentError, match="expected expressions of tiny, got those of flame2023_no_jaw"):
        avatar.draw(frame, avatar.camera)


def test_an_unknown_deformer_is_refused(bundle: Bundle) -> None:
    with pytest.raises(ArgumentError, match="deformer"):
        Avatar(bundle, deformer="int4")
