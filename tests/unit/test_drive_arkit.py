"""Apple's 52 on every rig: by name where there are names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from arkit_weights import arkit_weights
from drive_bundle import on_rig
from tiny_bundle import tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.arkit import NAMES, apple_name, arkit_map, gaze_of, look_weights
from cap4d.errors import ArgumentError
from cap4d.rig.head import HeadRig


@pytest.fixture(scope="module")
def builtin(builtin_rig: HeadRig) -> Bundle:
    return on_rig(builtin_rig, size=32)


@pytest.fixture(scope="module")
def ict(shared: Path) -> Bundle:
    from cap4d.rig.ict import import_ict

    return on_rig(import_ict(shared / "ict/ict_facekit_light.npz"), size=64)


def test_the_52_names_are_apples() -> None:
    assert len(NAMES) == len(set(NAMES)) == 52
    assert NAMES[0] == "eyeBlinkLeft" and NAMES[17] == "jawOpen" and NAMES[-1] == "tongueOut"
    pairs = [name for name in NAMES if name.endswith("Left") and name not in ("jawLeft", "mouthLeft")]
    assert len(pairs) == 18 and all(name[:-4] + "Right" in NAMES for name in pairs)


def test_the_built_in_head_has_all_of_them(builtin: Bundle) -> None:
    found = arkit_map(builtin)
    assert found.missing == () and not found.error_mm.any() and not found.jaw_rot.any()
    for name in NAMES:
        expr, _, _ = found(arkit_weights(**{name: 0.7}))
        moved = [builtin.subject.expression_names[i] for i in np.flatnonzero(expr)]
        assert moved == [name] and np.isclose(expr.max(), 0.7)


def test_ict_lacks_the_tongue_alone_and_splits_two(ict: Bundle) -> None:
    found = arkit_map(ict)
    assert found.missing == ("tongueOut",) and not found.error_mm.any()
    names = ict.subject.expression_names
    moved = lambda **values: [names[i] for i in np.flatnonzero(found(arkit_weights(**values))[0])]  # noqa: E731
    assert moved(browInnerUp=1) == ["browInnerUp_L", "browInnerUp_R"]
    assert moved(cheekPuff=1) == ["cheekPuff_L", "cheekPuff_R"]
    assert moved(eyeBlinkLeft=1) == ["eyeBlink_L"] and moved(tongueOut=1) == []
    assert (found.expr.sum(1) == 1).all(), "every shape of the rig is driven, by one name"


@pytest.mark.parametrize("rig", ["builtin", "ict"])
def test_left_is_the_persons_left_on_both_rigs(rig: str, request: pytest.FixtureRequest) -> None:
    """The rig's +x. A mirrored map would wink with the wrong eye."""
    subject, found = request.getfixturevalue(rig).subject, arkit_map(request.getfixturevalue(rig))
    for name in NAMES:
        if not name.endswith("Left") or name.startswith(("jaw", "mouthLeft", "eyeLook")):
            continue
        offsets = subject.pose(found(arkit_weights(**{name: 1}))[0]) - subject.pose(0 * found.expr[:, 0])
        moved = np.linalg.norm(offsets, axis=1)
        assert (moved * subject.neutral[:, 0]).sum() / moved.sum() > 0.005, name
    for name in ("jawLeft", "mouthLeft"):
        offsets = subject.pose(found(arkit_weights(**{name: 1}))[0]) - subject.pose(0 * found.expr[:, 0])
        assert offsets[np.linalg.norm(offsets, axis=1).argmax(), 0] > 0.003, name


def test_gaze_by_weight() -> None:
    """Against a row of a recording by the app: what its weights give and the angles it measured, rad."""
    row = arkit_weights(
        eyeLookOutLeft=0.5030736923,
        eyeLookUpLeft=0.3807524741,
        eyeLookInRight=0.5970684290,
        eyeLookUpRight=0.3733466268,
    )
    yaws, pitches = np.array([0.3596782684, 0.3029436469]), np.array([-0.1741501987, -0.1741401106])
    assert np.allclose(gaze_of(row), [pitches.mean(), yaws.mean(), 0], atol=0.02)
    down = arkit_weights(eyeLookDownLeft=0.2062367648, eyeLookDownRight=0.2062445730)
    assert np.isclose(gaze_of(down)[0], 0.1260434, atol=5e-4)


def test_gaze_there_and_back() -> None:
    for eye_rot in ([0.2, 0.1, 0], [-0.15, -0.3, 0], [0, 0, 0]):
        assert np.allclose(gaze_of(look_weights(np.float32(eye_rot))), eye_rot, atol=1e-6)


def test_gaze_moves_the_eyes_towards_where_it_says(builtin: Bundle) -> None:
    """Left is +x: an iris that looks to the person's left goes there."""
    _, eye_rot, _ = arkit_map(builtin)(arkit_weights(eyeLookOutLeft=1, eyeLookInRight=1))
    subject = builtin.subject
    eyes = [j for j, driver in enumerate(subject.joint_drivers) if driver == "eyes"]
    balls = subject.skin_weights[:, eyes].sum(1) > 0.99
    front = balls & (subject.neutral[:, 2] > np.quantile(subject.neutral[balls, 2], 0.9))
    moved = subject.pose(np.zeros(52, np.float32), eye_rot=eye_rot) - subject.neutral
    assert moved[front, 0].mean() > 0.004


def test_names_of_rigs() -> None:
    assert apple_name("jawOpen") == "jawOpen" and apple_name("mouthSmile_R") == "mouthSmileRight"
    assert apple_name("browInnerUp_L") == "browInnerUp" and apple_name("expr00") is None
    assert apple_name("blink") is None and apple_name("jawOpen_X") is None


def test_a_rig_without_names_is_refused_in_one_line() -> None:
    bundle = tiny_bundle(8, network=False)
    subject = replace(bundle.subject, expression_names=tuple("abcde"))
    with pytest.raises(ArgumentError, match="arkit: expected an avatar on a rig with"):
        arkit_map(replace(bundle, subject=subject, mesh_subject=None))
