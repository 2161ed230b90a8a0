"""A synthetic capture shows exactly what its fit.npz says; idle clips move naturally and loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cap4d.camera import opencv_from_rig
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError
from cap4d.mesh import rasterize_mesh
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.synth.capture import synthesize
from cap4d.synth.idle import expression_vector, idle_clip, look_weights


@pytest.fixture(scope="module")
def capture(builtin_rig, tmp_path_factory) -> Capture:
    path = tmp_path_factory.mktemp("synth")
    synthesize(builtin_rig, path, views=4, frames=5, size=96, seed=3)
    return Capture.load(path)


def test_layout(builtin_rig, capture):
    assert capture.rig_name == builtin_rig.name
    assert len(capture) == 5 and len(capture.cameras) == 4
    assert len(capture.views) == 3 * 5 + 2  # the fourth camera is behind and sees every fourth frame
    assert not capture.expr[0].any() and not capture.eye_rot[0].any()
    assert capture.expr[1:].any(1).all()
    for value, (low, high) in zip(capture.expr.T, builtin_rig.expression_range, strict=True):
        assert low <= value.min() and value.max() <= high
    assert np.abs(capture.eye_rot).max() <= 0.35
    for view in capture.views:
        assert capture.image(view).shape == (96, 96, 3)
        assert 0.2 < (capture.matte(view) > 0.5).mean() < 0.9


def test_parameters_reproject_onto_the_images(builtin_rig, capture):
    """Posing the rig with fit.npz through both camera conventions covers exactly the mattes."""
    subject = builtin_rig.subject(capture.shape)
    for view in capture.views[::3]:
        t = view.frame
        pose = {name: getattr(capture, name)[t] for name in ("eye_rot", "neck_rot")}
        head = subject.pose(capture.expr[t], **pose).astype(np.float64)
        world = head @ axis_angle_to_rotmat(capture.rot[t].astype(np.float64)).T + capture.tra[t]
        matte = capture.matte(view)
        for vertices, camera in ((head, capture.head_camera(view)), (world, capture.camera(view))):
            fragments = rasterize_mesh(opencv_from_rig(vertices), builtin_rig.faces, camera.resized(192, 192))
            covered = fragments.hit.reshape(96, 2, 96, 2).mean((1, 3))
            assert np.abs(covered - matte).mean() < 1e-3


def test_same_seed_same_images(builtin_rig, capture, tmp_path):
    synthesize(builtin_rig, tmp_path, views=4, frames=5, size=96, seed=3)
    again = Capture.load(tmp_path)
    for mine, theirs in zip(capture.views[::5], again.views[::5], strict=True):
        assert mine.image.read_bytes() == theirs.image.read_bytes()


def test_refuses_no_views(builtin_rig, tmp_path):
    with pytest.raises(ArgumentError, match="views"):
        synthesize(builtin_rig, tmp_path, views=0)


def test_idle_blinks_looks_and_speaks(builtin_rig):
    clip = idle_clip(builtin_rig, fps=30, seconds=8, seed=0)
    assert len(clip) == 240 and clip.rig_name == builtin_rig.name
    names = builtin_rig.expression_names
    blink = clip.expr[:, names.index("eyeBlinkLeft")]
    starts = np.flatnonzero((blink[1:] > 0.5) & (blink[:-1] <= 0.5))
    assert 2 <= len(starts) <= 5 and blink.max() > 0.95
    assert (blink > 0.05).mean() < 0.2  # and is open most of the time
    assert 0.15 < clip.expr[:, names.index("jawOpen")].max() < 0.7
    assert clip.expr[:, names.index("mouthSmileRight")].max() > 0.3
    assert 0.03 < np.abs(clip.eye_rot).max() < 0.4
    assert 0.01 < np.abs(clip.neck_rot).max() < 0.2
    np.testing.assert_array_equal(clip.expr, idle_clip(builtin_rig, fps=30, seconds=8, seed=0).expr)
    assert np.abs(clip.expr - idle_clip(builtin_rig, fps=30, seconds=8, seed=1).expr).max() > 0.2


def test_idle_loops(builtin_rig):
    clip = idle_clip(builtin_rig, seconds=6, seed=4)
    for track in (clip.expr, clip.eye_rot, clip.neck_rot):
        step = np.abs(np.diff(track, axis=0)).max()
        assert np.abs(track[0] - track[-1]).max() <= step


def test_idle_speaks_icts_spelling(builtin_rig):
    spelled = [n.replace("Left", "_L").replace("Right", "_R") for n in builtin_rig.expression_names]
    spelled = [{"jaw_L": "jawLeft", "mouth_L": "mouthLeft"}.get(n, n) for n in spelled]
    ict = replace(builtin_rig, expression_names=tuple(spelled))
    np.testing.assert_array_equal(idle_clip(ict, seed=2).expr, idle_clip(builtin_rig, seed=2).expr)


def test_idle_of_a_rig_without_names_stays_in_range(builtin_rig):
    names = (*(f"expr_{i}" for i in range(51)), "blink")
    span = np.tile(np.array([-2, 2], np.float32), (52, 1))
    span[51] = (-0.67, 0.93)
    clip = idle_clip(replace(builtin_rig, expression_names=names, expression_range=span), seconds=8)
    assert (clip.expr >= span[:, 0]).all() and (clip.expr <= span[:, 1]).all()
    assert clip.expr[:, 51].max() > 0.9
    assert 0.05 < clip.expr[:, :51].std() < 1


def test_expression_vector_sets_both_sides_or_one(builtin_rig):
    names = builtin_rig.expression_names
    both = expression_vector(builtin_rig, {"eyeBlink": 0.5, "noSuchThing": 1})
    assert {names[i] for i in np.flatnonzero(both)} == {"eyeBlinkLeft", "eyeBlinkRight"}
    assert both.max() == 0.5
    one = expression_vector(builtin_rig, {"eyeBlinkLeft": 1, "jawOpen": 0.25})
    assert {names[i] for i in np.flatnonzero(one)} == {"eyeBlinkLeft", "jawOpen"}


def test_lids_follow_the_gaze():
    down = look_weights(np.array([0.2, 0, 0]))
    assert down["eyeLookDown"] > 0.4 and down["eyeLookUp"] == 0
    left = look_weights(np.array([0, 0.2, 0]))
    assert left["eyeLookOutLeft"] == left["eyeLookInRight"] > 0.4 and left["eyeLookInLeft"] == 0
