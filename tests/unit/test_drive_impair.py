"""A bad line does what it says, no more, and the same again for the same seed. Time is passed in."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d.drive.impair import BadLine, Impairment, line_noise, parse_impairment
from cap4d.drive.packet import Rejected
from cap4d.drive.wire import parse_packet
from cap4d.errors import ArgumentError

FRAME = 1 / 30
COUNT = 20_000


def run(impairment: Impairment, *, count: int = COUNT, seed: int = 0, **options) -> list[tuple[float, bytes]]:
    """(arrival, message) of `count` messages, one a frame; a message is its number."""
    line = BadLine(impairment, seed=seed, frame_time=FRAME, **options)
    for i in range(count):
        line.put(b"%d" % i, i * FRAME)
    arrived = []
    while (due := line.due()) < float("inf"):
        arrived += [(due, message) for message in line.take(due)]
    return arrived


def delays(arrived: list[tuple[float, bytes]]) -> np.ndarray:
    return np.array([at - int(message) * FRAME for at, message in arrived])


def test_a_good_line_delivers_everything_in_order_at_once():
    arrived = run(Impairment(), count=100)
    assert arrived == [(i * FRAME, b"%d" % i) for i in range(100)]


def test_nothing_arrives_before_its_time():
    line = BadLine(Impairment())
    line.put(b"a", 1.0)
    assert line.take(0.999) == []
    assert line.due() == 1.0
    assert line.take(1.0) == [b"a"]
    assert line.due() == float("inf")


def test_loss_is_the_share_that_was_asked_for():
    lost = COUNT - len(run(Impairment(loss=0.05)))
    assert abs(lost / COUNT - 0.05) < 4 * np.sqrt(0.05 * 0.95 / COUNT)


def test_jitter_has_the_distribution_that_is_stated():
    late = delays(run(Impairment(jitter=0.04, reorder=1e-9)))
    assert late.min() >= 0
    assert late.max() <= 4 * 0.04 + 1e-9
    assert np.median(late) == pytest.approx(0.674 * 0.04, rel=0.03)
    assert np.percentile(late, 95) == pytest.approx(1.96 * 0.04, rel=0.03)


def test_without_reorder_a_late_message_holds_up_those_behind_it():
    arrived = run(Impairment(jitter=0.04))
    assert [int(message) for _, message in arrived] == list(range(COUNT))
    assert np.median(delays(arrived)) > 0.674 * 0.04  # the price of order


def test_reorder_holds_its_share_back_by_one_to_three_frames():
    late = delays(run(Impairment(reorder=0.05))) / FRAME
    held = late > 0.5
    assert abs(held.mean() - 0.05) < 4 * np.sqrt(0.05 * 0.95 / COUNT)
    assert set(np.round(late[held], 6)) == {1.0, 2.0, 3.0}
    order = [int(message) for _, message in run(Impairment(reorder=0.05))]
    assert order != sorted(order)
    assert sorted(order) == list(range(COUNT))


def test_duplicates_arrive_twice_each_late_by_itself():
    messages = [message for _, message in run(Impairment(duplicate=0.01, jitter=0.04, reorder=0.01))]
    twice = len(messages) - len(set(messages))
    assert abs(twice / COUNT - 0.01) < 4 * np.sqrt(0.01 * 0.99 / COUNT)


def test_garbage_is_no_frame_and_one_line():
    line = BadLine(Impairment(garbage=1.0), garbage=line_noise)
    good = b'{"t":1.5,"rig":"tiny","expr":[0.25,0.5]}\n'
    for _ in range(500):
        line.put(good, 0.0)
    garbage = [message for message in line.take(0.0) if message != good]
    assert len(garbage) == line.counts["garbage"] == 500
    for message in garbage:
        assert message.index(b"\n") == len(message) - 1
        with pytest.raises(Rejected):
            parse_packet(message)


def test_the_counts_are_what_happened():
    impairment = Impairment(loss=0.05, jitter=0.04, reorder=0.05, duplicate=0.02, garbage=0.03)
    line = BadLine(impairment, seed=3)
    for i in range(1000):
        line.put(b"%d" % i, i * FRAME)
    arrived = line.take(1e9)
    counts = line.counts
    assert len(arrived) == 1000 - counts["lost"] + counts["doubled"] + counts["garbage"]
    assert min(counts[name] for name in ("lost", "doubled", "garbage", "held", "late")) > 0


def test_the_seed_settles_everything():
    impairment = parse_impairment("loss=5%,jitter=40ms,reorder,duplicate=1%,garbage=1%")
    assert run(impairment, count=500, seed=7) == run(impairment, count=500, seed=7)
    assert run(impairment, count=500, seed=7) != run(impairment, count=500, seed=8)


def test_what_is_lost_does_not_hang_on_the_other_impairments():
    alone = {message for _, message in run(Impairment(loss=0.05), count=500)}
    with_more = {message for _, message in run(Impairment(loss=0.05, jitter=0.1, duplicate=0.1), count=500)}
    assert alone == with_more


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("loss=5%", Impairment(loss=0.05)),
        ("loss=0.05, jitter=40ms", Impairment(loss=0.05, jitter=0.04)),
        ("jitter=.5s,reorder", Impairment(jitter=0.5, reorder=0.05)),
        ("reorder=20%,duplicate=100%,garbage=0", Impairment(reorder=0.2, duplicate=1.0)),
    ],
)
def test_impairments_are_read(text, expected):
    assert parse_impairment(text) == expected


@pytest.mark.parametrize(
    "text",
    ["", "loss", "loss=", "loss=101%", "loss=-1%", "loss=nan", "loss=5%,loss=5%", "jitter=40", "jitter=60s"]
    + ["jitter=40%", "delay=4ms", "loss=5% jitter=4ms", "reorder=", "loss=1e-2"],
)
def test_what_is_no_impairment_is_refused(text):
    with pytest.raises(ArgumentError, match="impair: expected"):
        parse_impairment(text)
