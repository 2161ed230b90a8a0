"""`cap4d-view --serve`: from the command line to the page."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import ExitStack
from pathlib import Path

from cap4d.app.loading import open_playback
from cap4d.app.options import Options
from cap4d.app.serve.door import Door, parse_address
from cap4d.app.serve.performance import Performance
from cap4d.app.serve.server import PageServer
from cap4d.app.serve.studio import Studio

from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import STANDING, camera_path
from cap4d.player.offline import head_centre, statistics, write_stats

log = logging.getLogger(__name__)

MAX_WATCHERS = 4


def play_page(path: Path, options: Options) -> None:
    """Serves the avatar at `path` until interrupted.

    Raises:
        ArgumentError, DataError: What was asked for makes no sense, or a file is not sound.
        OSError: The address cannot be listened on.
    """
    import websockets  # noqa: F401  # its absence shows here, before anything is loaded

    check_options(options)
    host, port = parse_address(options.serve)
    door = Door(host, options.token)
    avatar = Avatar.load(path, deformer=options.deformer)
    with ExitStack() as stack:
        playback = open_playback(options.drive, avatar.bundle, **options.driving)
        stack.callback(playback.close)
        avatar.check_rig(playback.rig_name)
        if playback.is_live:
            log.info("listening for frames on %s", playback.name)
        fps, centre = 1 / playback.interval, head_centre(avatar)
        cameras = camera_path(options.camera, avatar.camera, centre, fps=fps, size=None)
        studio = Studio(
            avatar,
            Performance(playback, avatar.bundle),
            cameras,
            turns_head=playback.is_live and options.camera in STANDING,
            backend=options.backend,
            area=math.prod(options.picture_size),
            limit=MAX_WATCHERS,
        )
        studio.start()
        stack.callback(_finish, studio, options)
        serve_studio(studio, door, port, title=path.stem)


def _finish(studio: Studio, options: Options) -> None:
    studio.stop()
    if options.stats is not None:
        write_stats(options.stats, page_statistics(studio, options.picture_size))


def serve_studio(studio: Studio, door: Door, port: int, *, title: str) -> None:
    """Serves until interrupted, or the studio breaks."""
    server = PageServer(studio, door, title=title)

    def ready(port: int) -> None:
        log.info("%s", door.address(port))
        if not door.loopback:
            log.info("anybody who has this address can watch; the line is not encrypted. Ctrl-C ends it")

    async def run() -> None:
        await server.run(port, ready=ready, over=asyncio.Event())

    asyncio.run(run())
    if studio.failure is not None:
        raise studio.failure


def page_statistics(studio: Studio, size: tuple[int, int]) -> dict:
    """What `--stats` writes."""
    seconds = sum(studio.avatar.stages.seconds.get("frame", ()))
    found = statistics(studio.avatar, studio.moments, seconds, size=size, backend=studio.backend)
    performance = studio.performance
    found["serve"] = studio.statistics()
    return found | ({"drive": dict(performance.statistics())} if performance.is_live else {})


def check_options(options: Options) -> None:
    """Raises ArgumentError where `--serve` meets what it does not go with."""
    for name in ("headless", "out", "frames", "pipeline", "audio"):
        if getattr(options, name):
            raise ArgumentError(f"serve: goes without --{name}")
