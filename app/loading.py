"""Files to what plays: an avatar quickly, then as exactly as it can be; and sources for it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from cap4d.app.playback import ClipPlayback, Playback, StreamPlayback

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.reader import read_bundle
from cap4d.drive.fillers import Fillers
from cap4d.drive.live import LiveStream
from cap4d.drive.open_live import is_live, open_live
from cap4d.drive.source import open_source
from cap4d.player.avatar import Avatar
from cap4d.player.offline import head_centre

QUICK_TIERS = ("linear", "off")
"""Deformers that are there at once; the first that an avatar has shows its first picture."""
ALL: Mapping[str, bool] = {}
"""Every filler."""


@dataclass(frozen=True, eq=False)
class Loaded:
    """An avatar that can be drawn.

    Args:
        path: Its file.
        avatar: As it plays now.
        centre: [3] m the middle of its head, head-fixed world.
        is_settled: Its deformer is the one that was asked for; otherwise `settled` finds it.
    """

    path: Path
    avatar: Avatar
    centre: np.ndarray
    is_settled: bool = True

    @property
    def bundle(self) -> Bundle:
        return self.avatar.bundle

    @cached_property
    def tiers(self) -> tuple[str, ...]:
        """The bundle's; to find them it looks through the network, too slow for every picture."""
        return self.bundle.tiers


def load_avatar(path: Path, deformer: str = "auto") -> Loaded:
    """Reads an avatar. With `auto` it is drawn by a quick deformer for now, since finding the one that suits
    this machine takes as long as all the rest.

    Raises:
        ArgumentError: It does not have that deformer.
        DataError: It is not sound.
    """
    bundle = read_bundle(path)
    quick = next(tier for tier in QUICK_TIERS if tier in bundle.tiers) if deformer == "auto" else deformer
    avatar = Avatar(bundle, deformer=quick, source=str(path))
    return Loaded(path, avatar, head_centre(avatar), is_settled=quick == deformer or quick == bundle.tiers[0])


def with_deformer(loaded: Loaded, deformer: str) -> Loaded:
    """The same avatar with another deformer; `auto` measures: nothing else should run meanwhile.

    Raises:
        ArgumentError: It does not have that deformer.
        DataError: Its network does not load.
    """
    avatar = Avatar(loaded.bundle, deformer=deformer, source=str(loaded.path))
    return Loaded(loaded.path, avatar, loaded.centre)


def open_playback(
    spec: str | None,
    bundle: Bundle,
    *,
    template: Path | None = None,
    fps: float | None = None,
    sender: Path | None = None,
    fill: Mapping[str, bool] = ALL,
) -> Playback:
    """What drives an avatar, from `--drive`'s words; it starts now. What a live source lacks is filled in.

    Args:
        spec, bundle, template, fps, sender: See `open_source` and `open_live`.
        fill: Which fillers there are to be; see `Fillers`.
    Raises:
        ArgumentError, DataError: See `open_source` and `open_live`.
    """
    if is_live(spec):
        stream = open_stream(spec, bundle, template=template, fps=fps, sender=sender, fill=fill)
        return StreamPlayback(stream, rig_name=bundle.rig_name)
    clip = open_source(spec, bundle, template=template, fps=fps)
    name = "idle clip" if spec is None else Path(spec).name
    return ClipPlayback(clip, time.monotonic(), name=name)


def open_stream(
    spec: str,
    bundle: Bundle,
    *,
    template: Path | None = None,
    fps: float | None = None,
    sender: Path | None = None,
    fill: Mapping[str, bool] = ALL,
) -> LiveStream:
    """The live source of `open_playback` by itself; it starts as a context manager.

    Raises:
        ArgumentError, DataError: See `open_live`.
    """
    fillers = Fillers(bundle, **fill)
    return open_live(spec, bundle, template=template, fps=fps, sender=sender, fillers=fillers)
