"""What is shown in a gap: hold, ease, return; and never a jump."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d.drive.clip import Frame
from cap4d.drive.ease import EASE, HOLD, RETURN, Ease, smooth
from cap4d.drive.jitter_buffer import Moment

ZEROS = np.zeros(3, np.float32)
POSE = np.float32([0.1, 0.2, 0.3])


def face(value: float, t: float = 0.0, **pose: np.ndarray) -> Frame:
    return Frame(t, "tiny", np.float32([value]), ZEROS, value * POSE, ZEROS, **pose)


def moment(value: float, *, flows: bool = True) -> Moment:
    return Moment(face(value, rot=POSE, tra=POSE), flows, False, 0.0)


def follow(ease: Ease, moments: list[Moment | None], *, start: float = 0.0, dt: float = 0.01) -> list[Frame]:
    return [ease.follow(m, start + i * dt) for i, m in enumerate(moments)]


def values(frames: list[Frame]) -> np.ndarray:
    return np.array([frame.expr[0] for frame in frames])


def test_before_the_first_frame_the_face_is_neutral() -> None:
    ease = Ease(face(0))
    assert values(follow(ease, [None] * 50)).max() == 0 and ease.state == "waiting"


def test_a_gap_holds_then_eases_to_neutral_and_comes_back_without_a_jump() -> None:
    ease = Ease(face(0))
    shown = follow(ease, [moment(1)] * 100)
    assert shown[-1].expr[0] == 1 and ease.state == "playing"
    gap = follow(ease, [moment(1, flows=False)] * 150, start=1)
    held = round(HOLD / 0.01)
    np.testing.assert_allclose(values(gap[: held + 1]), 1)
    assert 0.3 < values(gap)[held + round(EASE / 2 / 0.01)] < 0.7
    assert values(gap)[held + round(EASE / 0.01) + 2 :].max() == 0 and ease.state == "waiting"
    np.testing.assert_array_equal(gap[-1].rot, POSE)  # the head stays where it was
    np.testing.assert_array_equal(gap[-1].neck_rot, ZEROS)
    back = follow(ease, [moment(1)] * 100, start=2.5)
    assert values(back)[round(RETURN / 0.01) + 1] == 1
    steps = np.abs(np.diff(values(shown + gap + back)))
    assert steps.max() < 1.6 * 0.01 / RETURN


@pytest.mark.parametrize("gap", [0.06, 0.2, 0.3, 0.6, 0.9])
def test_however_long_the_gap_the_way_back_is_smooth(gap) -> None:
    ease = Ease(face(0))
    shown = follow(ease, [moment(1)] * 100)
    shown += follow(ease, [None] * round(gap / 0.01), start=1)
    shown += follow(ease, [moment(-1)] * 100, start=1 + gap)
    steps = np.abs(np.diff(values(shown)))
    assert steps.max() < 1.6 * 2 * 0.01 / min(1.5 * gap, RETURN) and values(shown)[-1] == -1


def test_states_are_told() -> None:
    ease = Ease(face(0))
    told = []
    for i, m in enumerate([moment(1)] * 3 + [None] * 150):
        ease.follow(m, i * 0.01)
        told.append(ease.state)
    assert list(dict.fromkeys(told)) == ["playing", "holding", "easing", "waiting"]


def test_a_hiccup_is_no_gap() -> None:
    ease = Ease(face(0))
    follow(ease, [moment(0)] * 100)
    shown = follow(ease, [None] * 3 + [moment(1)], start=1)
    assert shown[-1].expr[0] == 1


def test_smooth_starts_and_ends_level() -> None:
    x = np.linspace(-0.5, 1.5, 201)
    y = np.array([smooth(v) for v in x])
    assert y[0] == 0 and y[-1] == 1 and (np.diff(y) >= 0).all()
    assert np.diff(y).max() <= 1.5 * 0.01 + 1e-9
