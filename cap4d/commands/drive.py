"""`cap4d drive`: any source to any viewer."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cap4d.commands.command import command

DRIVE = """The viewer listens: cap4d-view me.cap4d --drive tcp://127.0.0.1:9000. It may come and go; the
first frame waits for it. --impair makes the line worse, the same way for the same seed:

  loss=5%        frames that never arrive
  jitter=40ms    every frame is late by |x|, x normal with this deviation (at most 4 of them); in order
  reorder[=5%]   frames overtake one another, and these are held back by one to three frames besides
  duplicate=1%   arrive twice
  garbage=1%     have a message before them that is no frame"""


def add(commands) -> None:
    parser = command(
        commands,
        "drive",
        run_drive,
        "send a source to a viewer, in real time",
        "cap4d drive speech.npy --to tcp://127.0.0.1:9000 --impair loss=5%,jitter=40ms,reorder",
        more=DRIVE,
    )
    parser.add_argument(
        "source",
        metavar="SRC",
        help="fit.npz, vertices .npy, Live Link Face .csv, avatar.cap4d (its idle clip), - (NDJSON)",
    )
    parser.add_argument(
        "--to", required=True, metavar="URL", help="tcp://, udp://, ws:// or livelink://HOST:PORT, or -"
    )
    parser.add_argument("--impair", metavar="LIST", help="make the line worse, see above")
    parser.add_argument(
        "--fps", type=float, metavar="N", help="frames per second of the source, whatever it says itself"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="times as fast as recorded (default: 1)"
    )
    parser.add_argument("--loop", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument(
        "--as",
        dest="form",
        choices=("expr", "arkit", "vertices"),
        help="how frames are said (default: as the file has them)",
    )
    parser.add_argument(
        "--avatar", type=Path, metavar="AVATAR.cap4d", help="of the source's rig, to translate for --as"
    )
    parser.add_argument(
        "--template", type=Path, metavar="FILE", help="neutral vertices of an .npy, to translate it"
    )
    parser.add_argument("--token", metavar="X", help="what the viewer asks for")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="same seed: the same frames suffer (default: 0)"
    )


def run_drive(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.drive.send import Transmission, send

    send(Transmission(**{name: value for name, value in vars(arguments).items() if name != "run"}))
