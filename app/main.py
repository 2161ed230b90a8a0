"""`cap4d-view`: plays an avatar in a window, or without a display into a file."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from cap4d.app.options import Options, parse_options

from cap4d.errors import exit_code

log = logging.getLogger(__name__)

WINDOW = 1180, 760  # window units, where no size is asked for


def main(argv: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0 success, 1 bad data or no OpenGL, 2 a bad argument, 130 interrupted."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    # one frame's matrix products are small: a second BLAS thread costs more than it gives
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options = parse_options(argv)
    return exit_code("cap4d-view", lambda: play(options))


def play(options: Options) -> None:
    """Opens the window, or renders offline when there is to be none or can be none.

    Raises:
        ArgumentError: What is asked for cannot be.
        DataError: There is no avatar, or it is not sound.
    """
    from cap4d.bundle.reader import read_manifest
    from cap4d.player.video import check_file

    avatar = options.avatar if options.avatar is not None else demo_avatar()
    read_manifest(avatar)  # before a window opens for what is no avatar
    if options.stats is not None:
        check_file(options.stats, "stats")
    if options.serve is not None:
        from cap4d.app.serve.play import play_page

        play_page(avatar, options)
    elif options.headless or options.out is not None or not play_in_window(avatar, options):
        from cap4d.app.headless import play_headless

        play_headless(avatar, options)


def play_in_window(avatar: Path, options: Options) -> bool:
    """False, and one line that says so, where there is no display."""
    from cap4d.app.window import DisplayUnavailableError, Window

    try:
        window = Window(f"{avatar.name} - cap4d-view", *(options.size or WINDOW))
    except DisplayUnavailableError as error:
        log.info("%s; rendering offline instead", error)
        return False
    with window:
        window.clear()  # what follows takes a moment
        from cap4d.app.live import play_live

        play_live(avatar, options, window)
    return True


def demo_avatar() -> Path:
    """The built-in demo avatar, made the first time it is asked for."""
    from cap4d.demo import demo_avatar_path

    return demo_avatar_path()


if __name__ == "__main__":
    sys.exit(main())
