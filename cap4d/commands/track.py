"""`cap4d track`: video or photos become a capture."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import add_output, add_rig_option, command


def add(commands) -> None:
    parser = command(
        commands,
        "track",
        run_track,
        "turn a video or a folder of photos into a capture",
        "cap4d track me.mp4 --rig ict.npz -o capture",
    )
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="a video, an image, or a folder of images of one person"
    )
    add_rig_option(parser)
    add_output(
        parser,
        "CAPTURE",
        "folder to write: its parent must exist; an existing folder that is not empty is refused",
    )


def run_track(arguments: argparse.Namespace) -> None:
    from cap4d.capture.folder import check_new_folder
    from cap4d.rig.store import load_rig
    from cap4d.track import track
    from cap4d.track.footage import open_footage

    check_new_folder(arguments.output)
    open_footage(arguments.input)
    track(arguments.input, load_rig(arguments.rig), arguments.output)
