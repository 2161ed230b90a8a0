"""Floors from known counts and known ceilings, and targets that move with them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cap4d import _core
from cap4d.evaluate.bench.ceilings import ANCHORS, Ceilings, cache_bytes, measure_ceilings
from cap4d.evaluate.bench.floor import (
    adam_floor_ms,
    backward_floor,
    floors_ms,
    forward_floor,
    scaled_target_ms,
    total_ms,
)
from cap4d.evaluate.bench.work import Work

# The standard scene of 100,000 Gaussians, as counted.
HEAD_100K = Work(
    100_000, 100_000, 174_421, 3_212_702, 2_677_683, {4: 4_574_776, 8: 5_423_096, 16: 7_055_504}, 262_144, 16
)
ROUND = Ceilings(
    gflops=100, dram_copy=10, dram_read=10, llc_copy=20, llc_read=20, l2_copy=100, l2_read=100, sort_pass=1
)


def test_each_stage_stands_at_its_own_roof() -> None:
    stages = {stage.name: stage for stage in forward_floor(HEAD_100K, ROUND, lanes=16)}
    assert stages["project"].bytes == 100_000 * (11 + 48) * 4
    assert stages["project"].ms == pytest.approx(2.36)  # its bytes at 10 GB/s
    assert stages["sort"].ms == pytest.approx(0.2)  # two passes of 100,000 keys at 1e9 a second
    assert stages["bin"].ms == pytest.approx(0.174421)
    assert stages["blend"].flops == 7_055_504 * 34
    assert stages["blend"].ms == pytest.approx(7_055_504 * 34 / 100e9 * 1e3)
    assert stages["write"].ms == pytest.approx(262_144 * 16 / 10e9 * 1e3)


def test_a_stage_is_bound_by_the_slower_of_its_arithmetic_and_its_bytes() -> None:
    slow = replace(ROUND, gflops=1.0)
    stage = forward_floor(HEAD_100K, slow, lanes=16)[0]
    assert stage.ms == pytest.approx(stage.flops / 1e9 * 1e3)


def test_half_precision_colours_are_half_the_bytes() -> None:
    whole, half = (forward_floor(HEAD_100K, ROUND, lanes=16, half_sh=h)[0].bytes for h in (False, True))
    assert whole - half == 100_000 * 48 * 2


def test_backward_writes_a_gradient_for_every_number() -> None:
    stages = {stage.name: stage for stage in backward_floor(HEAD_100K, ROUND, lanes=16)}
    assert stages["write gradients"].bytes == 100_000 * (59 + 2) * 4
    assert stages["sum per Gaussian"].bytes == 2 * 174_421 * 40
    assert stages["blend backward"].flops == 7_055_504 * 54


def test_floors_at_the_anchors_are_those_the_targets_were_set_by() -> None:
    """Derived elsewhere by hand for this scene: 3.7 ms forward and 9.7 ms with the gradients."""
    floors = floors_ms(HEAD_100K, ANCHORS[2], lanes=16)
    assert floors["stateless"] == pytest.approx(3.7, rel=0.15)
    assert floors["forward_backward"] == pytest.approx(9.7, rel=0.15)
    assert floors["forward"] < floors["stateless"]


def test_targets_are_themselves_at_the_anchors_and_scale_with_the_machine() -> None:
    def scaled(ceilings: Ceilings) -> float:
        return scaled_target_ms(8.0, "forward", HEAD_100K, ceilings, lanes=16, threads=2)

    assert scaled(ANCHORS[2]) == pytest.approx(8.0)
    twice = Ceilings(*(2 * rate for rate in ANCHORS[2].report().values()))
    assert scaled(twice) == pytest.approx(4.0)


def test_adam_moves_seven_floats_a_value() -> None:
    assert adam_floor_ms(1_000_000, ROUND) == pytest.approx(2.8)
    assert total_ms([]) == 0


def test_ceilings_are_rates_of_this_machine() -> None:
    found = measure_ceilings(1, seconds=0.0).report()
    assert set(found) == set(ANCHORS[1].report())
    assert all(0 < rate < 1e5 for rate in found.values())


@pytest.mark.parametrize("bad", [(0, 0.1), (257, 0.1), (1, -1.0), (1, float("nan"))])
def test_ceilings_refuse_what_makes_no_sense(bad: tuple[int, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        _core.multiply_add_rate(*bad)
    with pytest.raises(ValueError, match="expected"):
        _core.copy_rate(1 << 20, *bad)


@pytest.mark.parametrize("size", [0, (1 << 32) + 1])
def test_ceilings_refuse_sizes_out_of_range(size: int) -> None:
    for rate in (_core.copy_rate, _core.read_rate, _core.sort_pass_rate):
        with pytest.raises(ValueError, match="size"):
            rate(size, 1, 0.0)


def test_cache_sizes_are_read_where_the_system_tells(tmp_path) -> None:
    for index, (kind, level, size) in enumerate(
        [("Data", 1, "32K"), ("Instruction", 2, "64K"), ("Unified", 2, "2048K")]
    ):
        folder = tmp_path / f"index{index}"
        folder.mkdir()
        for name, value in (("type", kind), ("level", level), ("size", size)):
            (folder / name).write_text(f"{value}\n")
    assert cache_bytes(2, folder=tmp_path) == 2 << 20
    assert cache_bytes(3, folder=tmp_path) == 32 << 20  # a usual one
    assert cache_bytes(2, folder=tmp_path / "nothing") == 1 << 20
