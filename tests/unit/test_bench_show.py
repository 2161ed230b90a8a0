"""Verdicts from made-up measurements, and what the report makes of them."""

from __future__ import annotations

from typing import Any

import pytest

from cap4d.evaluate.bench import sections
from cap4d.evaluate.bench.ceilings import ANCHORS
from cap4d.evaluate.bench.fitting import FUSED, OURS
from cap4d.evaluate.bench.plot_avatars import pareto
from cap4d.evaluate.bench.show import (
    Show,
    deformer_shows,
    fitting_shows,
    frame_shows,
    shrinking_shows,
    splatting_shows,
    verdict,
)
from cap4d.evaluate.bench.table import table
from cap4d.evaluate.bench.work import Work

WORK = Work(
    100_000, 100_000, 174_421, 3_212_702, 2_677_683, {4: 4_574_776, 8: 5_423_096, 16: 7_055_504}, 262_144, 16
)


def row(name: str, *, forward: float, both: float, blended: int, max_255: float = 0.4) -> dict[str, Any]:
    return {
        "name": name,
        "work": {**WORK.report(), "blended": blended},
        "forward": {"median_ms": forward},
        "stateless": {"median_ms": 1.1 * forward},
        "forward_backward": {"median_ms": both},
        "floor_ms": {"forward": 3.0, "forward_backward": 9.0},
        "of_floor": {"forward": 3.0 / forward, "forward_backward": 9.0 / both},
        "error": {"max_255": max_255, "psnr_db": 60.0},
    }


def splat(*rows: dict[str, Any]) -> dict[str, Any]:
    stage = {"name": "project", "ms": 2.0, "floor_ms": 1.0}
    return {"scenes": list(rows), "threads": 2, "roofline": [{"measured": [stage]}]}


def verdicts(shows) -> list[bool]:
    return [show.passed for show in shows if show.passed is not None]


@pytest.mark.parametrize(
    ("forward", "both", "max_255", "expected"),
    [(7.9, 19.9, 0.9, [True, True, True]), (8.1, 20.1, 1.1, [False, False, False])],
)
def test_the_targets_hold_at_the_anchors(
    forward: float, both: float, max_255: float, expected: list[bool]
) -> None:
    main = row("head_100k", forward=forward, both=both, blended=1000, max_255=max_255)
    shows = list(splatting_shows(splat(main), ANCHORS[2], lanes=16))
    assert verdicts(shows) == expected
    assert "moonshot 6" in shows[0].text and f"{300 / forward:.0f} % of the floor" in shows[0].text


def test_time_may_grow_as_the_blended_pairs_do_and_no_faster() -> None:
    main = row("head_100k", forward=4.0, both=10.0, blended=1000)
    fog = row("bad_100k", forward=40.0, both=90.0, blended=11_000)
    more = row("head_300k", forward=8.0, both=10.0, blended=1_200)
    shows = splatting_shows(splat(main, fog, more), ANCHORS[2], lanes=16)
    assert verdicts(shows)[3:] == [False, True]


def test_the_fused_step_is_held_against_the_other_one() -> None:
    steps = [{"name": FUSED, "median_ms": 3.0}, {"name": OURS, "median_ms": 2.0}]
    fit = {"gaussians": 100, "floor_ms": 1.0, "steps": steps}
    assert verdicts(fitting_shows(fit)) == [True]
    assert list(fitting_shows({**fit, "steps": steps[:1]})) == []


def tier(name: str, milliseconds: float | None, vertices: float = 0.5) -> dict[str, Any]:
    return {
        "tier": name,
        "pass": None if milliseconds is None else {"median_ms": milliseconds},
        "vertices": {"median_ms": vertices},
        "error": {"rms_mm": 0.1, "max_mm": 0.4},
    }


@pytest.mark.parametrize(
    ("full", "int8", "linear", "expected"),
    [(10.0, 4.0, 0.55, [True, True, True]), (11.0, 4.1, 0.7, [False, False, False])],
)
def test_tiers_are_held_against_plain_onnxruntime(
    full: float, int8: float, linear: float, expected: list[bool]
) -> None:
    avatar = {
        "avatar": "me.cap4d",
        "plain": {"spinning": {"median_ms": 10.0}, "resting": {"median_ms": 12.0}},
        "tiers": [tier("full", full), tier("int8", int8), tier("linear", None, linear), tier("off", None)],
    }
    assert verdicts(deformer_shows(avatar)) == expected
    assert verdicts(deformer_shows({**avatar, "plain": {}, "tiers": avatar["tiers"][:2]})) == []


def frame(tier: str, fps: float, uneven: float) -> dict[str, Any]:
    return {"tier": tier, "name": tier, "fps": fps, "p99_over_median": uneven, "psnr_db": 50.0}


def test_frames_must_be_many_and_even() -> None:
    rows = [frame("full", 26, 1.5), frame("int8", 46, 2.5), frame("linear", 79, 1.1), frame("off", 99, 1.0)]
    avatar = {"avatar": "me.cap4d", "gaussians": 100, "side": 512, "tiers": rows}
    assert verdicts(frame_shows(avatar)) == [True, False, False]
    faster = {**frame("linear", 90, 1.2), "name": "linear, pipelined"}
    shows = list(frame_shows({**avatar, "tiers": [*rows, faster]}))
    assert verdicts(shows) == [True, False, True] and "pipelined" in shows[2].text


@pytest.mark.parametrize(
    ("smaller", "faster", "expected"), [(4.0, 1.5, True), (3.9, 2.0, False), (9, 1.4, False)]
)
def test_an_optimised_avatar_must_be_smaller_and_faster(
    smaller: float, faster: float, expected: bool
) -> None:
    rows = [{"name": name, "psnr_db": 45.5} for name in ("full", "small")]
    found = {"avatar": "me.cap4d", "limit_db": 45, "smaller": smaller, "faster": faster, "rows": rows}
    assert verdicts(shrinking_shows(found)) == [expected]


def test_an_optimised_avatar_has_its_tables() -> None:
    row = {
        "bytes": 4_000_000,
        "tier": "int8",
        "gaussians": 900,
        "median_ms": 7.0,
        "p95_ms": 9.0,
        "psnr_db": 45.2,
    }
    found = {
        "avatar": "me.cap4d",
        "limit_db": 45.0,
        "rows": [{"name": "full", **row}],
        "steps": [{"name": "prune", "bytes": 4_000_000, "psnr_db": 45.2}],
    }
    page = list(sections.optimize(found))
    assert page[0] == "## `cap4d optimize` of me.cap4d at 45 dB"
    assert "| full | 4,000,000 | int8 | 900 | 7 | 9 | 45.2 |" in page
    assert "| prune | 4,000,000 | 45.2 |" in page


def test_a_verdict_counts_what_can_be_judged() -> None:
    shows = [Show(1, "a", True), Show(2, "b", False), Show(3, "c", None)]
    assert verdict(shows) == "1 of 2 lines pass"
    assert [show.line[:4] for show in shows] == ["pass", "FAIL", "    "]


def test_nothing_on_the_pareto_line_is_beaten_in_both() -> None:
    points = [(40.0, 5.0), (50.0, 9.0), (45.0, 9.5), (30.0, 2.0), (30.0, 3.0), (50.0, 12.0)]
    best = pareto([{"psnr_db": p, "median_ms": m} for p, m in points])
    assert [(c["psnr_db"], c["median_ms"]) for c in best] == [(30.0, 2.0), (40.0, 5.0), (50.0, 9.0)]


def test_tables_are_markdown() -> None:
    lines = table(("a", "b"), [("x", 1.23456), ("y", None), ("z", 1234567), ("w", 123456.7)])
    assert lines == [
        "| a | b |",
        "| --- | ---: |",
        "| x | 1.23 |",
        "| y | - |",
        "| z | 1,234,567 |",
        "| w | 123,457 |",
        "",
    ]
