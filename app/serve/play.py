"""`cap4d-view --serve`: from the command line to the page."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from contextlib import ExitStack
from pathlib import Path

from cap4d.app.options import Options
from cap4d.app.serve.gate import Gate, parse_address
from cap4d.app.serve.performance import ClipTime, Performance, StreamTime
from cap4d.app.serve.server import PageServer
from cap4d.app.serve.studio import Studio

from cap4d.drive.fillers import Fillers
from cap4d.drive.open_live import is_live, open_live
from cap4d.drive.source import open_source
from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import camera_path
from cap4d.player.offline import head_centre, statistics, write_stats
from cap4d.player.video import check_file

log = logging.getLogger(__name__)

MAX_WATCHERS = 4
SIZE = 512, 512  # px of the largest picture, unless told otherwise


def play_page(path: Path, options: Options) -> None:
    """Serves the avatar at `path` until interrupted.

    Raises:
        ArgumentError, DataError: What was asked for makes no sense, or a file is not sound.
        OSError: The address cannot be listened on.
    """
    import websockets  # noqa: F401  # its absence shows here, before anything is loaded

    check_options(options)
    host, port = parse_address(options.serve)
    gate = Gate(host, options.token)
    if options.stats is not None:
        check_file(options.stats, "stats")
    avatar = Avatar.load(path, deformer=options.deformer)
    with ExitStack() as stack:
        source = _open(options, avatar, stack)
        cameras = camera_path(options.camera, avatar.camera, head_centre(avatar), fps=source.fps, size=None)
        studio = Studio(
            avatar,
            Performance(source, avatar.bundle),
            cameras,
            backend=options.backend,
            area=math.prod(options.size or SIZE),
            limit=MAX_WATCHERS,
        )
        studio.start()
        stack.callback(_finish, studio, options)
        serve_studio(studio, gate, port, title=path.stem)


def _open(options: Options, avatar: Avatar, stack: ExitStack) -> ClipTime | StreamTime:
    if not is_live(options.drive):
        clip = open_source(options.drive, avatar.bundle, template=options.template, fps=options.fps)
        avatar.check_rig(clip.rig_name)
        return ClipTime(clip, time.monotonic())
    stream = open_live(
        options.drive,
        avatar.bundle,
        template=options.template,
        fps=options.fps,
        fillers=Fillers(avatar.bundle),
    )
    log.info("listening for frames on %s", stream.address)
    return StreamTime(stack.enter_context(stream))


def _finish(studio: Studio, options: Options) -> None:
    studio.stop()
    if options.stats is not None:
        write_stats(options.stats, page_statistics(studio, options.size or SIZE))


def serve_studio(studio: Studio, gate: Gate, port: int, *, title: str) -> None:
    """Serves until interrupted, or the studio breaks."""
    server = PageServer(studio, gate, title=title)

    def ready(port: int) -> None:
        log.info("%s", gate.address(port))
        if not gate.loopback:
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
    source = studio.performance.source
    return found | {"serve": studio.statistics()} | ({"drive": source.statistics()} if source.is_live else {})


def check_options(options: Options) -> None:
    """Raises ArgumentError where `--serve` meets what it does not go with."""
    for name in ("headless", "out", "frames", "pipeline"):
        if getattr(options, name):
            raise ArgumentError(f"serve: goes without --{name}")
