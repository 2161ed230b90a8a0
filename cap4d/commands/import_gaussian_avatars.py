"""`cap4d import gaussian-avatars`: an avatar of GaussianAvatars becomes a `.cap4d` file."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import check_output, command

DETAILS = """The avatar plays on FLAME's own triangles (with the teeth that GaussianAvatars adds), without a
network; its idle clip is the sequence of the parameters. Here one rotation turns both eyes: the mean of the
two. Colours that depend on the direction turn with the head, and are right for its mean pose."""


def add(kinds) -> argparse.ArgumentParser:
    """Adds the kind to those of `cap4d import`, which gives it `-o`."""
    files = "point_cloud.ply --flame flame2023.pkl"
    parser = command(
        kinds,
        "gaussian-avatars",
        run_gaussian_avatars,
        "an avatar of GaussianAvatars",
        f"cap4d import gaussian-avatars {files} -o me.cap4d",
        more=DETAILS,
    )
    parser.add_argument("ply", type=Path, metavar="POINT_CLOUD.ply", help="Gaussians bound to triangles")
    parser.add_argument(
        "--params",
        type=Path,
        metavar="FLAME_PARAM.npz",
        help="the person and the sequence (default: flame_param.npz beside the Gaussians)",
    )
    parser.add_argument(
        "--flame", type=Path, required=True, metavar="MODEL.pkl", help="FLAME 2020 or 2023, with a jaw"
    )
    parser.add_argument(
        "--fps", type=float, default=25.0, metavar="N", help="frames a second of the sequence (default: 25)"
    )
    return parser


def run_gaussian_avatars(arguments: argparse.Namespace) -> None:
    from cap4d.transfer.gaussian_avatars import import_gaussian_avatars

    check_output(arguments.output)
    import_gaussian_avatars(
        arguments.ply,
        arguments.output,
        params=arguments.params,
        flame=arguments.flame,
        fps=arguments.fps,
    )
