"""`cap4d import`: avatars made elsewhere become `.cap4d` files."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands import import_gaussian_avatars
from cap4d.commands.command import add_output, check_output, command

OFFICIAL = """MODEL_DIR is a folder that the released CAP4D code wrote: chkpntN.pth, of which the newest is
taken. It is a pickle; only tensors and plain containers are read of it, and nothing in it is executed. The
avatar stands on FLAME 2023 (no jaw) with the released assets, as it was fitted. It takes about 50 seconds of
one core, most of them to make and check the cheaper forms of its network."""


def add(commands) -> None:
    parser = command(
        commands,
        "import",
        None,
        "make a .cap4d file of an avatar that was made elsewhere",
        "cap4d import official MODEL_DIR --assets data/assets/flame --flame flame2023_no_jaw.pkl -o me.cap4d",
        more="Nothing in the files is executed. The avatar keeps the licences of its model and its maker.",
    )
    kinds = parser.add_subparsers(title="avatars", required=True, metavar="KIND")
    for kind in (_add_official(kinds), import_gaussian_avatars.add(kinds)):
        add_output(kind, "AVATAR.cap4d", "avatar to write; replaced if it exists")


def _add_official(kinds) -> argparse.ArgumentParser:
    official = command(
        kinds,
        "official",
        run_official,
        "an avatar of the released CAP4D code",
        "cap4d import official MODEL_DIR --assets data/assets/flame --flame flame2023_no_jaw.pkl -o me.cap4d",
        more=OFFICIAL,
    )
    official.add_argument(
        "model", type=Path, metavar="MODEL_DIR", help="folder with chkpntN.pth, or one such file"
    )
    _add_head_model(official)
    official.add_argument(
        "--clip",
        type=Path,
        metavar="FIT.npz",
        help="FlowFace sequence to play while nothing drives the avatar, and whose camera is its default "
        "view (default: gentle invented motion)",
    )
    return official


def _add_head_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--flame",
        type=Path,
        required=True,
        metavar="MODEL.pkl",
        help="as downloaded from flame.is.tue.mpg.de",
    )
    parser.add_argument(
        "--assets",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="folder of the CAP4D assets (template, blink, jaw regressor, vertex lists)",
    )


def run_official(arguments: argparse.Namespace) -> None:
    from cap4d.transfer.official import import_official

    check_output(arguments.output)
    import_official(
        arguments.model,
        arguments.output,
        flame=arguments.flame,
        assets=arguments.assets,
        clip=arguments.clip,
    )
