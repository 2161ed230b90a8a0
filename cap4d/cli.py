"""The `cap4d` command line; its commands are in `commands`.

Exit codes: 0 success, 1 bad data (one line: file, field, expected, found) or what the system refused, 2 a bad
argument or a missing package, 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence

from cap4d.commands import (
    bench,
    demo,
    drive,
    evaluate,
    export,
    fit,
    import_,
    inspect,
    optimize,
    protocol,
    render,
    rig,
    synth,
    track,
)
from cap4d.errors import exit_code
from cap4d.parser import OneLineParser

EXAMPLES = """examples:
  cap4d demo                                          # the built-in head, built once, then played
  cap4d demo --video me.mp4                           # the whole road from your video
  cap4d rig import ict FaceXModel -o ict.npz          # a head model (or: flame, builtin)
  cap4d track me.mp4 --rig ict.npz -o capture
  cap4d fit capture --rig ict.npz --preset low -o me.cap4d
  cap4d-view me.cap4d
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arguments = build_parser().parse_args(argv)
    return exit_code("cap4d", lambda: arguments.run(arguments))


def build_parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="cap4d",
        description="Photos or a video of a person in, a live 4D avatar out.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    from cap4d import __version__

    parser.add_argument("--version", action="version", version=f"cap4d {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    making = (demo, rig, track, synth, fit, import_, optimize)
    using = (render, drive, export, inspect, evaluate, protocol, bench)
    for room in making + using:
        room.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
