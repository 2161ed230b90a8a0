"""Whole frames on the CPU: how many a second, how even, how much memory, and what each shortcut costs in the
picture.
"""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.camera import Camera
from cap4d.drive.clip import Frame
from cap4d.evaluate.bench.accuracy import picture_error
from cap4d.evaluate.bench.child import ChildError, in_child
from cap4d.evaluate.bench.memory import peak_mb
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.tiers import clip_frames, load_tiers
from cap4d.evaluate.bench.tiled import render_tiled
from cap4d.evaluate.bench.timing import Timing
from cap4d.evaluate.image import mse, pooled_psnr
from cap4d.gaussians import SH_COUNTS, Gaussians
from cap4d.player.avatar import Avatar
from cap4d.player.offline import WHITE, draw_on_cpu, render_clip

log = logging.getLogger(__name__)

SIDE = 512  # px
SMALLER_SIDES = (384, 256)  # px, drawn smaller and enlarged, for the Pareto plot
BLOCK = 25  # frames of one tier in a row, before the next tier's turn
WARM_UP = 2  # frames of each block that do not count


@dataclass(frozen=True, eq=False)
class Way:
    """A tier, and whether the next frame's face is worked out while a frame is drawn."""

    tier: str
    avatar: Avatar
    pipelined: bool = False

    @property
    def name(self) -> str:
        return f"{self.tier}, pipelined" if self.pipelined else self.tier

    def play(self, camera: Camera) -> Iterator[np.ndarray]:
        """The idle clip for ever, through the same loop that writes videos."""
        avatar = self.avatar
        return render_clip(avatar, avatar.idle, lambda *_: camera, frames=1 << 30, pipelined=self.pipelined)


def measure_frames(path: Path, settings: Settings) -> dict[str, Any]:
    """One avatar: a row per tier, pipelined and not, and the configurations of the Pareto plot."""
    log.info("frame: %s", path)
    tiers = load_tiers(path, threads=settings.threads)
    first = next(iter(tiers.values()))
    camera = first.camera.resized(SIDE, SIDE)
    log.info("frame: %s: the truth in float64", path)
    samples = clip_frames(first.bundle, settings.samples)
    truths = [true_picture(pose_of(first, frame), camera) for frame in samples]
    ways = find_ways(path, tiers, settings)
    for way in ways:
        way.avatar.stages.clear()
    seconds = time_blocks({way.name: way.play(camera) for way in ways}, settings.frames)
    return {
        "avatar": path.name,
        "gaussians": len(first.bundle),
        "sh_degree": SH_COUNTS[first.bundle.sh.shape[1]],
        "side": SIDE,
        "truth": next(iter(tiers)),
        "samples": len(samples),
        "tiers": [
            {
                **_times(way, Timing(tuple(seconds[way.name]))),
                **pixel_error(way.avatar, samples, truths, camera),
                **_memory(path, way, settings),
            }
            for way in ways
        ],
        "configurations": _configurations(tiers, samples, truths, camera, settings),
    }


def find_ways(path: Path, tiers: dict[str, Avatar], settings: Settings) -> list[Way]:
    """Every tier, and those with a network pipelined too, on half of the threads for each of the two
    halves.
    """
    half = load_tiers(path, threads=max(1, settings.threads // 2))
    ways = []
    for tier, avatar in tiers.items():
        ways.append(Way(tier, avatar))
        if avatar.deformer is not None:
            ways.append(Way(tier, half[tier], pipelined=True))
    return ways


def _times(way: Way, timing: Timing) -> dict[str, Any]:
    found = timing.report()
    return {
        "tier": way.tier,
        "name": way.name,
        "fps": round(len(timing.seconds) / sum(timing.seconds), 2),
        **found,
        "p99_over_median": round(found["p99_ms"] / timing.median_ms, 3),
        "stages": way.avatar.stages.report(),
    }


def true_picture(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """float64 [H, W, 3] on white, in the range that a screen shows."""
    return np.clip(render_tiled(gaussians, camera).over(WHITE), 0, 1)


def pose_of(avatar: Avatar, frame: Frame) -> Gaussians:
    return avatar.pose(frame.expr, eye_rot=frame.eye_rot, neck_rot=frame.neck_rot, jaw_rot=frame.jaw_rot)


def pixel_error(
    avatar: Avatar, samples: list[Frame], truths: list[np.ndarray], camera: Camera
) -> dict[str, float]:
    """Of the 8-bit pictures of an avatar, drawn with `camera` and enlarged where that is smaller than the
    truth: PSNR of the squared error pooled over all samples, and the largest difference.
    """
    errors, largest = [], 0.0
    for frame, truth in zip(samples, truths, strict=True):
        image = draw_on_cpu(avatar, frame, camera)[..., :3].astype(np.float64) / 255
        image = enlarged(image, truth.shape[0])
        errors.append(mse(image, truth))
        largest = max(largest, picture_error(image, truth)["max_255"])
    return {"psnr_db": round(min(pooled_psnr(np.array(errors)), 999.0), 2), "max_255": round(largest, 2)}


def enlarged(image: np.ndarray, side: int) -> np.ndarray:
    """A square picture on more pixels, interpolated linearly between the pixel centres."""
    old = len(image)
    if old == side:
        return image
    at = np.clip((np.arange(side) + 0.5) * old / side - 0.5, 0, old - 1)
    low = np.minimum(at.astype(int), old - 2)
    share = (at - low)[:, None, None]
    rows = image[low] * (1 - share) + image[low + 1] * share
    share = share[None, :, 0]
    return rows[:, low] * (1 - share) + rows[:, low + 1] * share


def time_blocks(players: dict[str, Iterator[np.ndarray]], frames: int) -> dict[str, list[float]]:
    """Seconds of `frames` frames of each player, in blocks that take turns: within a block nothing else is
    run.

    A frame's time is from one picture to the next, as a viewer waits for it.
    """
    seconds: dict[str, list[float]] = {name: [] for name in players}
    while any(len(times) < frames for times in seconds.values()):
        for name, player in players.items():
            wanted = min(BLOCK - WARM_UP, frames - len(seconds[name]))
            for _ in range(WARM_UP):
                next(player)
            last = time.perf_counter()
            for _ in range(wanted):
                next(player)
                now = time.perf_counter()
                seconds[name].append(now - last)
                last = now
    return seconds


def memory_alone(*, path: str, tier: str, pipelined: bool, threads: int, frames: int) -> dict[str, float]:
    """A process that does nothing else than play: its memory at its peak after a few and after all frames,
    MB.
    """
    way = Way(tier, Avatar.load(path, deformer=tier, threads=threads), pipelined)
    player = way.play(way.avatar.camera.resized(SIDE, SIDE))
    for _ in range(5):
        next(player)
    early = peak_mb()
    for _ in range(frames):
        next(player)
    return {"memory_mb": round(peak_mb(), 1), "memory_grown_mb": round(peak_mb() - early, 1)}


def _memory(path: Path, way: Way, settings: Settings) -> dict[str, float]:
    arguments = {"path": str(path), "tier": way.tier, "pipelined": way.pipelined}
    try:
        return in_child("frame", **arguments, threads=way.avatar.threads, frames=settings.short_runs)
    except ChildError as error:
        log.warning("frame: %s in a process of its own: %s", way.name, error)
        return {}


def _configurations(
    tiers: dict[str, Avatar],
    samples: list[Frame],
    truths: list[np.ndarray],
    camera: Camera,
    settings: Settings,
) -> list[dict[str, Any]]:
    """Every tier at every SH degree, and every tier drawn smaller: time and error of each."""
    log.info("frame: configurations")
    degree = SH_COUNTS[next(iter(tiers.values())).bundle.sh.shape[1]]
    plans = [(tier, d, SIDE) for tier in tiers for d in range(degree + 1)]
    plans += [(tier, degree, side) for tier in tiers for side in SMALLER_SIDES]
    avatars = {plan: _with_sh_degree(tiers[plan[0]], plan[1]) for plan in plans}
    views = {plan: camera.resized(plan[2], plan[2]) for plan in plans}
    seconds = time_blocks(
        {str(plan): Way(plan[0], avatars[plan]).play(views[plan]) for plan in plans}, settings.short_runs
    )
    return [
        {
            "tier": tier,
            "sh_degree": d,
            "side": side,
            "median_ms": round(Timing(tuple(seconds[str((tier, d, side))])).median_ms, 3),
            **pixel_error(avatars[tier, d, side], samples, truths, views[tier, d, side]),
        }
        for tier, d, side in plans
    ]


def _with_sh_degree(avatar: Avatar, degree: int) -> Avatar:
    """The same avatar, network and all, drawn with SH up to a degree."""
    count = (degree + 1) ** 2
    if count == avatar.bundle.sh.shape[1]:
        return avatar
    reduced = copy.copy(avatar)
    reduced.bundle = replace(avatar.bundle, sh=np.ascontiguousarray(avatar.bundle.sh[:, :count]))
    reduced.splatter = Avatar(reduced.bundle, deformer="off").splatter
    return reduced
