"""What panels say, as words and numbers."""

import numpy as np
import pytest
from cap4d.app.panels.look import error_text
from cap4d.app.panels.timing import STEPS_MS, graph_top, statistics_rows
from cap4d.app.panels.transport import clock_text
from cap4d.app.panels.widgets import color32, shortened, signless_zero
from cap4d.app.timings import FPS_SECONDS, HISTORY, STAGES, Timings

from cap4d.player.stages import Stages


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00.0"), (1.26, "0:01.2"), (62.3, "1:02.3"), (600, "10:00.0")]
)
def test_times_of_a_clip(seconds, text):
    assert clock_text(seconds) == text


def test_a_tiers_error_is_never_nothing():
    assert error_text((0.0034, 0.02)) == "0.003 mm"
    assert error_text((1e-7, 1e-6)) == "< 0.001 mm"
    assert error_text(None) == "not measured"


def test_the_counts_of_a_live_source_are_unfolded_and_causes_without_one_left_out():
    counts = {
        "received": 12345,
        "depth_ms": 41.25,
        "connected": True,
        "rejected": {"not_finite": 2, "rig": 0},
    }
    counts |= {"clock_jumps": 1, "latency_ms": {"median": 31.5, "p95": 0.0}}
    assert statistics_rows(counts) == [
        ("received", "12,345"),
        ("depth, ms", "41.2"),
        ("connected", "yes"),
        ("rejected, not finite", "2"),
        ("clock jumps", "1"),
        ("latency, median ms", "31.5"),
    ]


def test_a_graph_is_as_high_as_nearly_all_pictures():
    rows = np.full((100, len(STAGES)), 1.0)
    assert graph_top(rows) == STEPS_MS[1]  # 6 ms
    rows[7] = 500
    assert graph_top(rows) == STEPS_MS[1]
    assert graph_top(np.full((5, len(STAGES)), 1e6)) == STEPS_MS[-1]
    assert graph_top(np.zeros((0, len(STAGES)))) == STEPS_MS[0]


def test_words_fit_and_zero_has_no_sign():
    assert shortened("short") == "short"
    assert len(shortened("a" * 500)) <= 26
    assert (signless_zero("-0.00"), signless_zero("-0.01")) == ("0.00", "-0.01")
    assert color32((1.0, 0.5, 0.0, 1.0)) == 0xFF0080FF


def test_the_graph_remembers_what_each_picture_took():
    timings, stages = Timings(), Stages()
    for i in range(HISTORY + 50):
        for name, seconds in (("rig", 0.001), ("sort", 0.002), ("splat", 0.01)):
            stages.add(name, seconds)
        timings.picture(stages, "cpu", i / 20)
    rows = timings.rows()
    assert rows.shape == (HISTORY, len(STAGES))
    by_name = dict(zip(STAGES, rows[-1], strict=True))
    assert by_name == pytest.approx(
        {"rig": 1, "deform": 0, "bind": 0, "sort": 2, "splat": 8, "gui": 0}
    )  # the CPU's splatting has its sorting in it
    assert timings.milliseconds() == pytest.approx({"rig": 1, "sort": 2, "splat": 8})
    assert timings.fps() == pytest.approx(20, abs=0.5)
    assert timings.pictures_per_second(1e6 + FPS_SECONDS) == 0


def test_nothing_was_shown_yet():
    timings = Timings()
    assert timings.rows().shape == (0, len(STAGES))
    assert timings.fps() == timings.pictures_per_second(0.0) == 0
