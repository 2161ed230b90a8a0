"""`cap4d synth`: a capture of a person who does not exist, with everything about it known."""

from __future__ import annotations

import argparse

from cap4d.commands.command import add_output, add_rig_option, command

DEVIATIONS = """Real faces move in ways that no head model has: with --deviations 1 (the default) so do these,
by a few millimetres where expressions meet, while the capture keeps the head model's own parameters.
--deviations 0 moves exactly as the head model does."""


def add(commands) -> None:
    parser = command(
        commands,
        "synth",
        run_synth,
        "draw a capture of a person who does not exist, from many cameras",
        "cap4d synth --rig ict.npz --identity 1 --views 16 --frames 100 -o person1",
        more=DEVIATIONS,
    )
    add_rig_option(parser)
    parser.add_argument(
        "--identity",
        type=int,
        default=1,
        metavar="N",
        help="who: the same number, the same person (default: 1)",
    )
    parser.add_argument("--views", type=int, default=16, metavar="N", help="cameras (default: 16)")
    parser.add_argument("--frames", type=int, default=100, metavar="N", help="frames of each (default: 100)")
    parser.add_argument("--size", type=int, default=512, metavar="PX", help="pixels a side (default: 512)")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of cameras and performance (default: 0)"
    )
    parser.add_argument(
        "--deviations", type=float, default=1.0, metavar="X", help="0: moves as the model (default: 1)"
    )
    add_output(parser, "CAPTURE", "folder to write: its parent must exist; it must not hold anything yet")


def run_synth(arguments: argparse.Namespace) -> None:
    from cap4d.capture.folder import check_new_folder
    from cap4d.rig.store import load_rig
    from cap4d.synth.capture import check_sizes, synthesize

    sizes = {
        name: getattr(arguments, name)
        for name in ("identity", "views", "frames", "size", "seed", "deviations")
    }
    check_sizes(**sizes)
    check_new_folder(arguments.output)
    synthesize(load_rig(arguments.rig), arguments.output, **sizes)
