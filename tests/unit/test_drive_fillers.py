"""Blinks, glances and a breathing neck: there when the source has none, gone when it has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import RIG_NAME, tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.clip import Frame
from cap4d.drive.fillers import (
    QUIET_SECONDS,
    Fillers,
    glance_at,
    lid_closure,
    lids_of,
    sway_at,
)

BLINKS = (1, 2)  # of tiny_bundle's expressions
START = 1000.0  # s, where the clock stands


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return tiny_bundle(8, network=False)


def frame(t: float = 0.0, **changes: np.ndarray) -> Frame:
    zeros = np.zeros(3, np.float32)
    return replace(Frame(t, RIG_NAME, np.zeros(5, np.float32), zeros, zeros, zeros), **changes)


def vec(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def run(fill: Fillers, source, times: np.ndarray) -> list[Frame]:
    return [fill(source(t), START + t) for t in times]


def still(_t: float) -> Frame:
    return frame()


def lids(frames: list[Frame]) -> np.ndarray:
    return np.array([f.expr[BLINKS[0]] for f in frames])


def test_a_still_face_comes_alive(bundle: Bundle) -> None:
    times = np.arange(0, 60, 1 / 60)
    frames = run(Fillers(bundle), still, times)
    shut = lids(frames)
    blinks = ((shut[1:] > 0.5) & (shut[:-1] <= 0.5)).sum()
    assert 12 <= blinks <= 20, "about 17 a minute"
    assert np.isclose(shut.max(), 1, atol=0.01) and shut.min() == 0
    assert all(np.array_equal(f.expr[1], f.expr[2]) for f in frames), "both eyes"
    assert np.degrees(np.abs([f.eye_rot for f in frames]).max()) > 3
    neck = np.degrees([f.neck_rot for f in frames])
    assert 0.2 < neck.std(0)[0] < 1 and np.abs(neck).max() < 2
    assert all(f.t == 0 and f.rot is None for f in frames)


@pytest.mark.parametrize("left", ["blink", "gaze", "neck", None])
def test_each_is_off_by_itself(bundle: Bundle, left: str | None) -> None:
    on = {name: name == left for name in ("blink", "gaze", "neck")}
    frames = run(Fillers(bundle, **on), still, np.arange(0, 20, 1 / 60))
    moves = {
        "blink": lids(frames).any(),
        "gaze": np.abs([f.eye_rot for f in frames]).any(),
        "neck": np.abs([f.neck_rot for f in frames]).any(),
    }
    assert moves == on


def test_the_source_is_never_written_to_and_untouched_frames_are_the_same_object(bundle: Bundle) -> None:
    source = frame()
    fill = Fillers(bundle)
    for t in np.arange(0, 10, 1 / 60):
        fill(source, START + t)
    assert not (source.expr.any() or source.eye_rot.any() or source.neck_rot.any())
    nothing = Fillers(bundle, blink=False, gaze=False, neck=False)
    assert nothing(source, START) is source


def test_a_source_that_has_them_is_left_alone(bundle: Bundle) -> None:
    def lively(t: float) -> Frame:
        blink = np.float32(t % 3 < 0.2)
        turn = vec(0.1 * np.sin(t), 0.1 * np.cos(1.3 * t), 0)
        return frame(t, expr=vec(0.2, blink, blink, 0, 0), eye_rot=turn, neck_rot=turn)

    times = np.arange(0, 30, 1 / 60)
    frames = run(Fillers(bundle), lively, times)
    for t, filled in zip(times[600:], frames[600:], strict=True):
        source = lively(t)
        for name in ("expr", "eye_rot", "neck_rot"):
            assert np.array_equal(getattr(filled, name), getattr(source, name)), (name, t)


def test_it_comes_back_when_the_source_falls_still(bundle: Bundle) -> None:
    def falls_still(t: float) -> Frame:
        return frame(eye_rot=vec(0, 0.2 * np.sin(3 * min(t, 5.0)), 0))

    times = np.arange(0, 40, 1 / 30)
    frames = run(Fillers(bundle, blink=False, neck=False), falls_still, times)
    extra = np.array([f.eye_rot - falls_still(t).eye_rot for t, f in zip(times, frames, strict=True)])
    own = (times > 1) & (times < 5 + QUIET_SECONDS - 0.5)
    assert not extra[own].any() and extra[times > 5 + QUIET_SECONDS + 2].any()


def test_the_noise_of_a_tracker_is_no_gaze(bundle: Bundle) -> None:
    rng = np.random.default_rng(0)
    noisy = lambda _t: frame(eye_rot=rng.normal(0, 0.001, 3).astype(np.float32))  # noqa: E731
    frames = run(Fillers(bundle, blink=False, neck=False), noisy, np.arange(0, 20, 1 / 60))
    assert np.abs([f.eye_rot for f in frames]).max() > 0.03


def test_a_blink_shuts_lids_that_the_source_holds_half_shut_or_wide(bundle: Bundle) -> None:
    half = lambda _t: frame(expr=vec(0, 0.5, 0.3, 0, 0))  # noqa: E731
    frames = run(Fillers(bundle, gaze=False, neck=False), half, np.arange(0, 20, 1 / 120))
    left, right = np.array([f.expr[list(BLINKS)] for f in frames]).T
    assert np.isclose(left.max(), 1, atol=0.01) and left.max() <= 1 and np.isclose(left.min(), 0.5)
    assert np.isclose(right.max(), 1, atol=0.01)


def test_a_blink_is_fast_down_and_slow_up() -> None:
    times = np.arange(0, 120, 0.001)
    shut = np.array([lid_closure(t, 5) for t in times])
    rises = np.flatnonzero((shut[1:] > 0.02) & (shut[:-1] <= 0.02))
    single = []
    for start in rises:
        end = start + 1 + np.argmax(shut[start + 1 :] <= 0.02)
        full = start + np.flatnonzero(shut[start:end] > 0.999)
        if shut[end] <= 0.02 and (np.diff(full) == 1).all():
            single.append((full[0] - start, full[-1] - full[0], end - full[-1]))
    down, closed, up = np.median(single, 0)
    print(f"{len(single)} blinks: {down:.0f} ms down, {closed:.0f} ms shut, {up:.0f} ms up")
    assert len(single) > 25 and 70 < down < 130 and 1.3 * down < up < 300 and closed < 120


def test_blinks_are_neither_regular_nor_rare() -> None:
    shut = np.array([lid_closure(t, 1) > 0.5 for t in np.arange(0, 1800, 0.02)])
    at = np.flatnonzero(shut[1:] & ~shut[:-1]) * 0.02
    assert 14 < len(at) / 30 < 18, "a minute"
    assert np.diff(at).std() > 1 and np.diff(at).max() < 7.5


def test_saccades_follow_the_main_sequence() -> None:
    """Bigger is longer and faster: 21 ms + 2.2 ms/deg; a peak of some hundred degrees a second."""
    step = 0.0005
    gaze = np.degrees([glance_at(t, 2) for t in np.arange(0, 120, step)])
    speed = np.linalg.norm(np.diff(gaze, axis=0), axis=1) / step
    moving = np.diff(np.concatenate([[0], speed > 1e-6, [0]]).astype(int))
    starts, ends = np.flatnonzero(moving == 1), np.flatnonzero(moving == -1)
    size = np.linalg.norm(gaze[ends] - gaze[starts], axis=1)
    seconds, peak = (
        (ends - starts) * step,
        np.array([speed[a:b].max() for a, b in zip(starts, ends, strict=True)]),
    )
    big = size > 3
    print(f"{len(size)} saccades, {size.min():.1f} to {size.max():.1f} deg, fastest {peak.max():.0f} deg/s")
    assert 110 < len(size) < 145 and 25 < big.sum() < 90
    assert np.allclose(seconds, 0.021 + 0.0022 * size, atol=0.005)
    assert 100 < np.median(peak[big]) < 600
    assert np.corrcoef(size, peak)[0, 1] > 0.9


def test_the_frame_rate_changes_nothing(bundle: Bundle) -> None:
    slow = run(Fillers(bundle, seed=4), still, np.arange(0, 30, 1 / 30))
    fast = run(Fillers(bundle, seed=4), still, np.arange(0, 30, 1 / 120))
    for a, b in zip(slow, fast[::4], strict=True):
        for name in ("expr", "eye_rot", "neck_rot"):
            assert np.allclose(getattr(a, name), getattr(b, name), atol=0.035), name
    for a, b in zip(slow[60:], fast[240::4], strict=True):  # after it has faded in: to rounding
        assert np.allclose(a.expr, b.expr, atol=1e-5) and np.allclose(a.eye_rot, b.eye_rot, atol=1e-5)


def test_the_seed_says_all(bundle: Bundle) -> None:
    times = np.arange(0, 20, 1 / 30)
    a, b, c = (run(Fillers(bundle, seed=s), still, times) for s in (1, 1, 2))
    same = lambda x, y: all(np.array_equal(p.eye_rot, q.eye_rot) for p, q in zip(x, y, strict=True))  # noqa: E731
    assert same(a, b) and not same(a, c)


@pytest.mark.parametrize("jump", [1e9, -1e9, 1e-12, 0.0, np.nan, np.inf])
def test_clocks_that_jump_cost_nothing_and_leave_no_poison(bundle: Bundle, jump: float) -> None:
    fill = Fillers(bundle, seed=-3)
    for now in (START, START + 1, START + 2, START + 2 + jump, START + 3, START + 3 + jump):
        filled = fill(frame(), now)
        assert np.isfinite([*filled.expr, *filled.eye_rot, *filled.neck_rot]).all()
        assert np.abs(filled.eye_rot).max() < 0.4 and 0 <= filled.expr[1] <= 1


def test_rigs_without_a_blink_have_none(bundle: Bundle) -> None:
    nameless = replace(bundle, subject=replace(bundle.subject, expression_names=tuple("abcde")))
    assert lids_of(nameless) is None
    frames = run(Fillers(nameless), still, np.arange(0, 10, 1 / 60))
    assert not np.array([f.expr for f in frames]).any() and np.abs([f.neck_rot for f in frames]).any()


def test_a_rigs_own_blink_is_used() -> None:
    """FLAME's 65th expression in the released system (fact 4)."""
    names = ("expr00", "expr01", "expr02", "expr03", "blink")
    bundle = tiny_bundle(8, network=False)
    flame = replace(bundle, subject=replace(bundle.subject, expression_names=names))
    found = lids_of(flame)
    assert np.array_equal(found.closed, vec(0, 0, 0, 0, 1)) and found.signal.shape == (1, 5)


def test_sway_is_slow_and_small() -> None:
    neck = np.degrees([sway_at(t, 0) for t in np.arange(0, 60, 0.01)])
    assert np.abs(neck).max() < 1.5 and np.abs(np.diff(neck, axis=0) / 0.01).max() < 2.5
