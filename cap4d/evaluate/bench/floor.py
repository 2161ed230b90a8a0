"""The least time that the counted work takes at the machine's ceilings: each stage at its own roof, one
after the other.

A stage is bound by its arithmetic or by its bytes, whichever is slower (a roofline, Williams et al. 2009).
Arithmetic is counted as the operations of our own formulas, at the multiply-add peak; nothing is added for
latency, branches or imbalance. The pixels' registers are not full: lanes without a blended pixel cost what
the others do.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from cap4d.evaluate.bench.ceilings import ANCHORS, Ceilings
from cap4d.evaluate.bench.work import Work

# Operations per blended pixel-Gaussian pair, counted in the formulas of src/cpp/rasterize.cpp.
# Evaluate: offsets 2, shear 2, exponent 6, exp2 13 (3 and a polynomial of degree 5), weight 1, transmittance
# 1.
EVALUATE_FLOPS = 25
ACCUMULATE_FLOPS = 9  # three colours 6, alpha 1, depth 2
GRADIENT_FLOPS = 29  # value 6, own share and what is behind 2, d ln(alpha) 4, colours 6, moments 11
# Operations per drawn Gaussian in src/cpp/project.h and sh.h, SH aside.
PROJECT_FLOPS = 230
PROJECT_VJP_FLOPS = 290
SH_FLOPS, SH_VJP_FLOPS = 8, 16  # per coefficient of all three channels: the sum 6, the basis about 2

FLOAT = 4  # bytes
GEOMETRY_FLOATS = 11  # mean 3, quaternion 4, scale 3, opacity 1
PLAY_FLOATS, TRAIN_FLOATS = 4, 5  # a pixel's rgb and alpha; and depth
SPLAT_FLOATS = 11  # of a pair: position 2, shape 3, opacity 1, colour 3, depth 1, and the index that finds it
SPLAT_GRAD_FLOATS = 10  # what one Gaussian receives in one tile
MEANS2D_FLOATS = 2  # the gradient that densification reads
SORT_PASSES, BIN_PASSES = 2, 1  # depths to 16 bits, two digits; pairs dealt out once


@dataclass(frozen=True)
class Stage:
    """One stage's operations and bytes, and the least milliseconds they take."""

    name: str
    flops: float
    bytes: float
    ms: float

    def report(self) -> dict[str, float | str]:
        return {**asdict(self), "ms": round(self.ms, 4)}


def forward_floor(work: Work, ceilings: Ceilings, *, lanes: int, half_sh: bool = False) -> list[Stage]:
    """Stages of drawing a picture for the eye.

    Args:
        lanes: Floats in a register: 4, 8 or 16.
        half_sh: The SH are stored in float16.
    """
    flops = work.drawn * (PROJECT_FLOPS + SH_FLOPS * work.sh_count)
    sh_bytes = 3 * work.sh_count * (FLOAT // 2 if half_sh else FLOAT)
    parameters = work.gaussians * (GEOMETRY_FLOATS * FLOAT + sh_bytes)
    blend = work.lanes[lanes] * (EVALUATE_FLOPS + ACCUMULATE_FLOPS)
    return [
        _stage("project", flops, parameters, ceilings, ceilings.dram_read),
        _sort("sort", SORT_PASSES * work.drawn, ceilings),
        _sort("bin", BIN_PASSES * work.pairs, ceilings),
        _stage("blend", blend, work.pairs * SPLAT_FLOATS * FLOAT, ceilings, ceilings.l2_read),
        _stage("write", 0, work.pixels * PLAY_FLOATS * FLOAT, ceilings, ceilings.dram_copy),
    ]


def backward_floor(work: Work, ceilings: Ceilings, *, lanes: int) -> list[Stage]:
    """Stages of all gradients, given the picture and its own gradient."""
    floats = work.gaussians * (GEOMETRY_FLOATS + 3 * work.sh_count)
    blend = work.lanes[lanes] * (EVALUATE_FLOPS + GRADIENT_FLOPS)
    flops = work.drawn * (PROJECT_FLOPS + PROJECT_VJP_FLOPS + (SH_FLOPS + SH_VJP_FLOPS) * work.sh_count)
    images = work.pixels * 2 * TRAIN_FLOATS * FLOAT
    between = 2 * work.pairs * SPLAT_GRAD_FLOATS * FLOAT
    written = (floats + work.gaussians * MEANS2D_FLOATS) * FLOAT
    return [
        _stage("read images", 0, images, ceilings, ceilings.dram_read),
        _stage("blend backward", blend, work.pairs * SPLAT_FLOATS * FLOAT, ceilings, ceilings.l2_read),
        _stage("sum per Gaussian", 0, between, ceilings, ceilings.llc_copy),
        _stage("project backward", flops, floats * FLOAT, ceilings, ceilings.dram_read),
        _stage("write gradients", 0, written, ceilings, ceilings.dram_copy),
    ]


def adam_floor_ms(values: int, ceilings: Ceilings) -> float:
    """Adam in place on float32: value, gradient and two moments read, all but the gradient written."""
    return values * 7 * FLOAT / max(ceilings.dram_copy, ceilings.dram_read) * 1e-6


def total_ms(stages: list[Stage]) -> float:
    return sum(stage.ms for stage in stages)


def floors_ms(work: Work, ceilings: Ceilings, *, lanes: int) -> dict[str, float]:
    """Floors of `forward` (prepared Gaussians, SH in float16), `stateless` and `forward_backward`."""
    play = total_ms(forward_floor(work, ceilings, lanes=lanes, half_sh=True))
    forward = total_ms(forward_floor(work, ceilings, lanes=lanes))
    backward = total_ms(backward_floor(work, ceilings, lanes=lanes))
    return {"forward": play, "stateless": forward, "forward_backward": forward + backward}


def scaled_target_ms(
    target_ms: float, pass_name: str, work: Work, ceilings: Ceilings, *, lanes: int, threads: int
) -> float:
    """A target that was set at the ceilings of `ANCHORS`, at these: both stand in the same relation to the
    floor.

    Args:
        pass_name: A key of `floors_ms`.
        lanes: Of this machine; the anchors' machine has 16.
    """
    here = floors_ms(work, ceilings, lanes=lanes)[pass_name]
    there = floors_ms(work, ANCHORS[min(threads, max(ANCHORS))], lanes=16)[pass_name]
    return target_ms * here / there


def _stage(name: str, flops: float, size: float, ceilings: Ceilings, rate: float) -> Stage:
    return Stage(name, flops, size, max(flops / ceilings.gflops, size / rate) * 1e-6)


def _sort(name: str, key_passes: int, ceilings: Ceilings) -> Stage:
    size = key_passes * 2 * 2 * FLOAT  # key and value, read and written
    return Stage(name, 0, size, key_passes / ceilings.sort_pass * 1e-6)
