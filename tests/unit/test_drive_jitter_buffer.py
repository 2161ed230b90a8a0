"""The buffer of live frames on an accelerated clock: depth, rates, blinks, late frames, clock jumps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cap4d.drive.clip import Frame
from cap4d.drive.counts import Counts
from cap4d.drive.jitter_buffer import MAX_FRAMES, SLEW, JitterBuffer
from cap4d.drive.packet import Cause
from cap4d.drive.sample import mix

ZEROS = np.zeros(3, np.float32)
EPOCH = 5000.0  # s, what the display's clock shows when the stream begins


def frame(t: float, *values: float) -> Frame:
    return Frame(t, "tiny", np.float32(values), ZEROS, ZEROS, ZEROS)


@dataclass
class Played:
    """What a display showed: times, moments of the stream, expressions, ages, all [N]."""

    counts: Counts
    buffer: JitterBuffer
    pushed: int = 0
    now: list[float] = field(default_factory=list)
    t: list[float] = field(default_factory=list)
    expr: list[np.ndarray] = field(default_factory=list)
    age: list[float] = field(default_factory=list)
    flows: list[bool] = field(default_factory=list)

    def adds_up(self) -> None:
        buffer = self.buffer
        fates = buffer.shown + buffer.dropped + buffer.waiting + sum(self.counts.by_cause().values())
        assert fates == self.pushed

    def after(self, seconds: float) -> slice:
        return slice(int(np.searchsorted(self.now, EPOCH + seconds)), None)

    def speed(self, seconds: float = 0.5) -> np.ndarray:
        """Seconds of stream a second, after the first pictures."""
        kept = self.after(seconds)
        return np.diff(self.t[kept]) / np.diff(self.now[kept])


def play(
    frames: list[Frame],
    arrivals: np.ndarray,
    *,
    display: float = 60.0,
    phase: float = 0.37,
    seconds: float | None = None,
    watch: Callable[[JitterBuffer, float], None] = lambda buffer, now: None,
) -> Played:
    """Frames that arrive, and a display that asks, in the order of their times (after `EPOCH`)."""
    counts = Counts()
    played = Played(counts, JitterBuffer(counts), len(frames))
    seconds = float(np.max(arrivals)) + 0.5 if seconds is None else seconds
    events = [(a, 0, f) for a, f in zip(arrivals, frames, strict=True)]
    events += [((i + phase) / display, 1, None) for i in range(int(seconds * display))]
    for at, _, item in sorted(events, key=lambda event: event[:2]):
        now = EPOCH + at
        if item is not None:
            played.buffer.push(item, now)
        elif (moment := played.buffer.sample(now)) is not None:
            played.now.append(now)
            played.t.append(moment.frame.t)
            played.expr.append(moment.frame.expr)
            played.age.append(now - moment.arrival)
            played.flows.append(moment.flows)
        watch(played.buffer, now)
    played.adds_up()
    return played


def ramp(rate: float, seconds: float, *, start: float = 0.0) -> list[Frame]:
    """Frames whose expression is their stamp."""
    return [frame(start + i / rate, start + i / rate) for i in range(int(seconds * rate))]


def stamps(frames: list[Frame]) -> np.ndarray:
    return np.array([f.t for f in frames])


@pytest.mark.parametrize("display", [24.0, 30.0, 60.0, 144.0])
@pytest.mark.parametrize("rate", [24.0, 25.0, 30.0, 60.0])
def test_any_rate_plays_on_any_display_at_its_own_speed(rate, display) -> None:
    frames = ramp(rate, 6)
    played = play(frames, stamps(frames), display=display, seconds=6)
    kept = played.after(4)
    np.testing.assert_allclose(played.speed(4), 1, atol=1e-4)
    # the picture is the moment's, or a frame's since the last picture where the weight turned round
    np.testing.assert_allclose(np.array(played.expr[kept])[:, 0], played.t[kept], atol=1e-5)
    np.testing.assert_allclose(played.age[kept], 1 / rate + 2e-3, atol=1e-3)
    assert not played.counts.by_cause() and all(played.flows[kept])


def test_the_depth_follows_the_jitter_and_nothing_jumps_meanwhile() -> None:
    rng = np.random.default_rng(0)
    frames = ramp(60, 60)
    t = stamps(frames)
    arrivals = t + np.where((t > 10) & (t < 30), rng.uniform(0, 0.06, len(t)), 0)
    depths = {}
    played = play(frames, arrivals, watch=lambda buffer, now: depths.update({now: buffer.depth}))
    calm, wild, calm_again = (
        np.median([d for at, d in depths.items() if start < at - EPOCH < start + 8]) for start in (2, 21, 48)
    )
    assert calm == pytest.approx(1 / 60 + 2e-3, abs=2e-3)
    assert wild == pytest.approx(1 / 60 + 2e-3 + 0.03, abs=6e-3)  # the middle frame waits for the latest
    assert calm_again == pytest.approx(calm, abs=2e-3)
    moving = np.array(played.speed(1))
    assert moving.max() < 1 + SLEW + 1e-6 and moving.min() >= 0
    stands = moving[: -int(0.6 * 60)] < 1 - SLEW - 1e-6  # for a moment where the jitter begins, no more
    assert 0 < stands.mean() < 0.01
    late = played.buffer.overdue + played.counts.by_cause().get("late", 0)
    assert late < 0.03 * len(frames)


@settings(max_examples=60, deadline=None)
@given(
    rate=st.sampled_from([24.0, 25.0, 30.0, 60.0]),
    display=st.sampled_from([10.0, 15.0, 24.0, 30.0, 48.0, 60.0, 90.0]),
    phase=st.floats(0, 1),
    rise=st.integers(1, 4),
)
def test_a_blink_closes_the_eye_at_any_display_rate_and_phase(rate, display, phase, rise) -> None:
    """The lids are shut in one frame only."""
    shape = {k: 1 - abs(k) / rise for k in range(-rise + 1, rise)}
    values = [shape.get(i - 90, 0.0) for i in range(150)]
    frames = [frame(i / rate, v, -v) for i, v in enumerate(values)]
    expr = np.array(play(frames, stamps(frames), display=display, phase=phase).expr)
    assert expr[:, 0].max() >= 0.95 and expr[:, 1].min() <= -0.95
    assert expr[:, 0].min() == 0  # and it opens again, without a swing beyond
    assert expr[-1, 0] == 0


def test_a_blink_closes_when_the_frames_around_its_peak_are_lost() -> None:
    values = np.zeros(120)
    values[60:65] = 0.3, 0.7, 1.0, 0.7, 0.3
    kept = [i for i in range(120) if i not in (61, 63)]
    frames = [frame(i / 30, values[i]) for i in kept]
    expr = np.array(play(frames, stamps(frames), display=30, phase=0.7).expr)
    assert expr.max() == 1


def test_lips_that_touch_for_one_frame_are_seen_to_touch_on_a_slow_display() -> None:
    jaw = np.where(np.arange(300) == 150, 0.0, 0.6)
    frames = [frame(i / 60, value) for i, value in enumerate(jaw)]
    for phase in np.linspace(0, 0.9, 10):
        played = play(frames, stamps(frames), display=20, phase=phase)
        assert np.array(played.expr)[played.after(1)].min() == 0


def test_frames_out_of_order_are_put_in_order() -> None:
    frames = ramp(60, 5)
    t = stamps(frames)
    swapped = t + np.where(np.arange(len(t)) % 2 == 0, 0.025, 0.0)  # each second one after its successor
    played = play(frames, swapped, seconds=5)
    kept = played.after(1)
    np.testing.assert_allclose(np.array(played.expr[kept])[:, 0], played.t[kept], atol=1e-5)
    assert played.speed(1).min() >= 0
    assert sum(played.counts.by_cause().values()) <= 2  # before it knew how late they come


def test_duplicates_are_counted_and_change_nothing() -> None:
    frames = ramp(60, 3)
    once = play(frames, stamps(frames))
    twice = play(frames + frames, np.concatenate([stamps(frames), stamps(frames) + 0.2]))
    assert twice.counts.by_cause() == {"duplicate": len(frames)}
    np.testing.assert_array_equal(once.expr, twice.expr[: len(once.expr)])


def test_a_frame_whose_moment_is_over_is_late() -> None:
    frames = ramp(60, 3)
    arrivals = stamps(frames)
    arrivals[100] += 0.15
    played = play(frames, arrivals)
    assert played.counts.by_cause() == {"late": 1}
    assert played.speed()[:140].min() > 0.5
    assert played.speed().max() < 1 + SLEW + 1e-6


def test_a_late_frame_is_shown_where_there_is_nothing_newer() -> None:
    frames = ramp(30, 3)
    arrivals = stamps(frames)
    arrivals[-1] += 0.15
    played = play(frames, arrivals)
    assert not played.counts.by_cause() and played.buffer.overdue == 1
    assert played.expr[-1][0] == frames[-1].expr[0]


@pytest.mark.parametrize("jump", [-3600.0, -2.0, -0.4, 0.4, 5.0, 1e9])
def test_a_jump_of_the_clock_is_followed(jump) -> None:
    frames = ramp(60, 3) + ramp(60, 5, start=3 + jump)
    arrivals = np.concatenate([stamps(frames[:180]), stamps(frames[180:]) - jump])
    played = play(frames, arrivals)
    assert played.buffer.clocks == 2
    gap = np.diff([now for now, flows in zip(played.now, played.flows, strict=True) if flows]).max()
    assert gap < 0.15
    kept = slice(played.after(5).start, played.after(7.9).start)
    np.testing.assert_allclose(played.age[kept], 1 / 60, atol=8e-3)
    assert sum(played.counts.by_cause().values()) == 0


def test_single_stamps_that_make_no_sense_are_refused() -> None:
    frames, arrivals = ramp(60, 4), list(stamps(ramp(60, 4)))
    for at, t in ((1.001, 1e9), (2.001, -50.0), (3.001, 4.1)):
        frames.append(frame(t, 99.0))
        arrivals.append(at)
    played = play(frames, np.array(arrivals))
    assert played.counts.by_cause() == {"time": 2, "late": 1}
    assert np.max(played.expr) < 5 and played.buffer.clocks == 1
    np.testing.assert_allclose(played.speed(1)[:150], 1, atol=SLEW)


@pytest.mark.parametrize("drift", [-2e-3, -1e-4, 1e-4, 2e-3])
def test_a_sender_whose_clock_drifts_is_followed_without_delay(drift) -> None:
    frames = ramp(30, 240)
    played = play(frames, stamps(frames) * (1 + drift), display=30)
    assert played.buffer.clocks == 1 and not played.counts.by_cause()
    ages = np.array(played.age)
    early, late = ages[played.after(15)][:300], ages[-700:-100]
    assert abs(np.median(late) - np.median(early)) < 2e-3
    assert np.median(late) < 1 / 30 + 0.025


def test_a_stall_is_caught_up_with_at_once() -> None:
    """A second without arrivals, then everything in a burst, as TCP does it after a loss."""
    frames = ramp(60, 6)
    t = stamps(frames)
    arrivals = np.where((t > 3) & (t < 4), 4 + 1e-4 * t, t)
    played = play(frames, arrivals)
    ages = np.array(played.age)[np.array(played.flows)]
    assert played.t[-1] == pytest.approx(frames[-1].t)
    assert np.median(ages[-60:]) < 0.2
    assert not all(played.flows[played.after(2.9)])


def test_nothing_is_interpolated_over_a_long_gap() -> None:
    frames = [f for f in ramp(30, 6) if not 2 < f.t < 4]
    played = play(frames, stamps(frames))
    values = np.array(played.expr)[:, 0]
    assert not ((values > 2.01) & (values < 3.99)).any()


def test_nobody_looking_holds_no_more_frames_than_there_are_places() -> None:
    buffer = JitterBuffer(Counts())
    for i in range(5 * MAX_FRAMES):
        buffer.push(frame(i / 60, 0.0), i / 60)
    assert buffer.waiting == MAX_FRAMES and buffer.dropped == 4 * MAX_FRAMES
    assert buffer.sample(5 * MAX_FRAMES / 60).frame.t > 5 * MAX_FRAMES / 60 - 0.1


def test_a_head_pose_that_only_some_frames_have_does_no_harm() -> None:
    bare, posed = frame(0.0, 0.0), Frame(1.0, "tiny", np.float32([1]), ZEROS, ZEROS, ZEROS, ZEROS, ZEROS)
    assert mix(bare, posed, 0.5).rot is not None and mix(posed, bare, 0.5).rot is None
    turned = Frame(1.0, "tiny", np.float32([1]), np.float32([0, 2, 0]), ZEROS, ZEROS)
    assert (
        mix(bare, turned, 0.4).eye_rot[1] == 0 and mix(bare, turned, 0.6).eye_rot[1] == 2
    )  # a cut stays one


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(-1e11, 1e11) | st.floats(0, 3) | st.integers(0, 60).map(lambda i: i / 20),
            st.floats(0, 3),
        ),
        max_size=60,
    ),
    st.sampled_from([5.0, 30.0, 60.0]),
)
def test_whatever_the_stamps_it_goes_on_and_the_counts_add_up(pairs, display) -> None:
    frames = [frame(t, np.sin(t)) for t, _ in pairs]
    played = play(frames, np.array([at for _, at in pairs]), display=display, seconds=4)
    assert np.isfinite(played.t).all() and (np.abs(np.array(played.expr)) <= 1).all()
    assert set(played.counts.by_cause()) <= {str(Cause.LATE), str(Cause.DUPLICATE), str(Cause.TIME)}
