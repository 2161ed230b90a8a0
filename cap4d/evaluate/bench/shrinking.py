"""`cap4d optimize`: how much smaller it makes an avatar and how much faster its frames, at a stated error."""

from __future__ import annotations

import importlib
import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cap4d.evaluate.bench.frames import SIDE, Way, pixel_error, pose_of, time_blocks, true_picture
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.tiers import TIERS, clip_frames
from cap4d.evaluate.bench.timing import Timing
from cap4d.player.avatar import Avatar

log = logging.getLogger(__name__)

MAX_ERROR_DB = 45.0


def measure_shrinking(path: Path, settings: Settings) -> dict[str, Any]:
    """One avatar before and after: bytes, Gaussians, milliseconds a frame in turns, PSNR of its pixels.

    Raises:
        ModuleNotFoundError: torch is not installed.
    """
    importlib.import_module("torch")
    from cap4d.optimize.optimize import optimize

    log.info("optimize: %s", path)
    with TemporaryDirectory() as folder:
        small = Path(folder) / "small.cap4d"
        found = optimize(path, small, max_error_db=MAX_ERROR_DB)
        sizes = {"full": path.stat().st_size, "small": small.stat().st_size}
        avatars = {name: load_best(file, settings) for name, file in (("full", path), ("small", small))}
    camera = avatars["full"].camera.resized(SIDE, SIDE)
    samples = clip_frames(avatars["full"].bundle, settings.samples)
    truths = [true_picture(pose_of(avatars["full"], frame), camera) for frame in samples]
    players = {name: Way(avatar.tier, avatar).play(camera) for name, avatar in avatars.items()}
    times = {name: Timing(tuple(s)) for name, s in time_blocks(players, settings.frames).items()}
    return {
        "avatar": path.name,
        "limit_db": MAX_ERROR_DB,
        "smaller": round(sizes["full"] / sizes["small"], 3),
        "faster": round(times["full"].median_ms / times["small"].median_ms, 3),
        "rows": [
            {
                "name": name,
                "bytes": sizes[name],
                "tier": avatar.tier,
                "gaussians": len(avatar.bundle),
                **times[name].report(),
                **pixel_error(avatar, samples, truths, camera),
            }
            for name, avatar in avatars.items()
        ],
        "steps": [{"name": s.name, "bytes": s.size, "psnr_db": round(s.psnr, 2)} for s in found.steps],
    }


def load_best(path: Path, settings: Settings) -> Avatar:
    """The avatar with the most exact deformer that it has."""
    avatar = Avatar.load(path, deformer="auto", threads=settings.threads, deformer_budget_ms=float("inf"))
    assert avatar.tier in TIERS
    return avatar
