"""`cap4d optimize`: a smaller and faster avatar."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cap4d.commands.command import add_avatar, add_output, check_output, command

OPTIMIZE = """Takes out what is not used, picks the cheapest deformer, stores numbers in fewer bits,
lowers the degree of the spherical harmonics and prunes Gaussians; each only while the pictures stay near
enough to those of the full avatar in float64. The error is the squared error pooled over frames of the
idle clip, from the default view and around it, on black and on white. Steps learn from other frames than
it is measured on."""


def add(commands) -> None:
    parser = command(
        commands,
        "optimize",
        run_optimize,
        "make an avatar's file smaller and its frames faster, to a stated error",
        "cap4d optimize me.cap4d --max-error 45dB -o small.cap4d",
        more=OPTIMIZE,
    )
    add_avatar(parser)
    parser.add_argument("--max-error", metavar="45dB", help="PSNR that the pictures must keep")
    parser.add_argument("--max-size", metavar="20MB", help="size that the file must have, at the least error")
    parser.add_argument(
        "--capture", type=Path, metavar="CAPTURE", help="look at the training views of this capture too"
    )
    add_output(parser, "SMALL.cap4d", "avatar to write; replaced if it exists, and never AVATAR itself")


def run_optimize(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.optimize.limit import parse_decibels, parse_size
    from cap4d.optimize.optimize import optimize
    from cap4d.optimize.report import table

    check_output(arguments.output)
    report = optimize(
        arguments.avatar,
        arguments.output,
        max_error_db=None if arguments.max_error is None else parse_decibels(arguments.max_error),
        max_bytes=None if arguments.max_size is None else parse_size(arguments.max_size),
        capture=arguments.capture,
    )
    print(table(report))
