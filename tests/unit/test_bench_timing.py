"""What the bench's times and errors mean; never how long anything takes."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
import pytest

from cap4d.evaluate.bench import memory
from cap4d.evaluate.bench.accuracy import picture_error, relative_error, vertex_error_mm
from cap4d.evaluate.bench.frames import enlarged, time_blocks
from cap4d.evaluate.bench.memory import memory_of
from cap4d.evaluate.bench.timing import Timing, measure


def test_percentiles_are_of_all_runs_in_milliseconds() -> None:
    found = Timing(tuple(0.001 * n for n in range(101))).report()
    expected = {"median_ms": 50, "p95_ms": 95, "p99_ms": 99, "least_ms": 0, "runs": 101}
    assert found == pytest.approx(expected)


def test_calls_take_turns_and_the_first_of_a_turn_does_not_count() -> None:
    done: list[str] = []
    now = iter(range(100))
    calls = {name: (lambda name=name: done.append(name)) for name in "ab"}
    timings = measure(calls, runs=6, clock=lambda: float(next(now)))
    assert timings["a"].seconds == timings["b"].seconds == (1.0,) * 6
    turns = [done[:5], done[5:10], done[10:13], done[13:]]
    assert all(len(set(turn)) == 1 for turn in turns) and len(done) == 16
    assert {turns[0][0], turns[1][0]} == {turns[2][0], turns[3][0]} == {"a", "b"}


def test_frames_take_turns_in_blocks() -> None:
    done: list[str] = []

    def player(name: str):
        while True:
            done.append(name)
            yield np.zeros(1)

    seconds = time_blocks({name: player(name) for name in "ab"}, 30)
    assert {name: len(times) for name, times in seconds.items()} == {"a": 30, "b": 30}
    assert done[:25] == ["a"] * 25 and done[25:50] == ["b"] * 25
    assert done[50:59] == ["a"] * 9  # two that warm up, seven that are left


def test_picture_errors_are_steps_of_255_and_decibels() -> None:
    truth = np.zeros((4, 4, 3))
    picture = truth.copy()
    picture[0, 0, 0] = 2 / 255
    mean_square = (2 / 255) ** 2 / 48
    found = picture_error(picture, truth)
    assert found["max_255"] == pytest.approx(2)
    assert found["rms_255"] == pytest.approx(255 * mean_square**0.5, rel=1e-4)
    assert found["psnr_db"] == pytest.approx(-10 * np.log10(mean_square), abs=0.01)
    assert picture_error(truth, truth)["psnr_db"] == 999.0


def test_vertex_errors_are_distances_in_millimetres() -> None:
    truth = np.zeros((2, 2, 3))
    moved = truth.copy()
    moved[1, 1] = [0.003, 0.0, 0.004]
    assert vertex_error_mm(moved, truth) == {"rms_mm": 2.5, "max_mm": 5.0}


def test_relative_errors_are_of_norms() -> None:
    assert relative_error(np.array([3.0, 4.0]), np.array([0.0, 4.0])) == pytest.approx(0.75)
    assert relative_error(np.zeros(3), np.zeros(3)) == 0


def test_enlarging_keeps_straight_lines() -> None:
    at = (np.arange(8) + 0.5) / 8
    small = np.stack([np.add.outer(at, 2 * at)] * 3, -1)
    large = enlarged(small, 16)
    fine = (np.arange(16) + 0.5) / 16
    expected = np.add.outer(fine, 2 * fine)
    assert np.allclose(large[1:-1, 1:-1, 0], expected[1:-1, 1:-1])  # beyond the last centres it holds still
    assert enlarged(small, 8) is small


@pytest.mark.parametrize("peak", ["set back", "not set back"])
def test_memory_of_a_call_is_what_it_takes_on_top(peak: str, monkeypatch, tmp_path: Path) -> None:
    if peak == "not set back":  # as in a container that does not let it
        monkeypatch.setattr(memory, "CLEAR", tmp_path / "no such folder" / "clear_refs")
    held = []

    def take() -> None:  # from the system: what the allocator has kept of earlier tests is held already
        held.append(mmap.mmap(-1, 64_000_000))
        np.frombuffer(held[0], np.float64)[:] = 1

    found = memory_of(take)
    assert 60 < found < 90
    assert memory_of(lambda: None) < 5
