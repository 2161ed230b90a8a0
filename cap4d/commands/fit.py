"""`cap4d fit`: captures become an avatar."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import add_output, add_rig_option, check_output, command

HELD_OUT = """held-out frames (every 10th and the last tenth of a video, or those the capture marks) are never
trained on; their expressions and poses come from the tracker, which sees all frames."""


def add(commands) -> None:
    parser = command(
        commands,
        "fit",
        run_fit,
        "fit an avatar to one or more captures of a person",
        "cap4d fit capture --rig ict.npz --preset low -o me.cap4d",
        more=HELD_OUT,
    )
    parser.add_argument(
        "captures",
        type=Path,
        nargs="+",
        metavar="CAPTURE",
        help="folders made by `cap4d track`; the first gives the identity and the idle clip",
    )
    add_rig_option(parser)
    add_output(
        parser,
        "AVATAR.cap4d",
        "avatar to write; beside it go numbers (.fit.json) and a picture (.fit.png)",
    )
    parser.add_argument(
        "--preset",
        default="low",
        choices=("debug", "low"),
        help="debug: a minute; low: for CPUs, 256x256 (default: low)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint of an interrupted fit"
    )
    parser.add_argument(
        "--ablate",
        choices=("unet", "remesh"),
        help="leave a part out, to see what it is worth: the deformation network, or the UV grid with it",
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="same seed, same machine: same avatar (default: 0)"
    )


def run_fit(arguments: argparse.Namespace) -> None:
    from cap4d.avatar.fit import fit
    from cap4d.rig.store import load_rig

    check_output(arguments.output)
    fit(
        arguments.captures,
        load_rig(arguments.rig),
        arguments.output,
        preset=arguments.preset,
        resume=arguments.resume,
        ablate=arguments.ablate,
        seed=arguments.seed,
    )
