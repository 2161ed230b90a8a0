"""What the commands share: the layout of their help, and arguments that mean the same in each."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def command(
    commands, name: str, run: Callable | None, help: str, example: str, *, more: str = ""
) -> argparse.ArgumentParser:
    """A subparser with the house's layout: what it does, its options, an example.

    Args:
        run: None for a group of commands.
        more: Lines below what it does.
    """
    parser = commands.add_parser(
        name,
        help=help,
        description=help[0].upper() + help[1:] + "." + ("\n\n" + more if more else ""),
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if run is not None:
        parser.set_defaults(run=run)
    return parser


def add_rig_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rig", type=Path, required=True, metavar="RIG.npz", help="head model, made by `cap4d rig import`"
    )


def add_avatar(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("avatar", type=Path, metavar="AVATAR.cap4d", help="made by `cap4d fit`")


def add_output(parser: argparse.ArgumentParser, metavar: str, help: str, *, required: bool = True) -> None:
    parser.add_argument("-o", "--output", type=Path, required=required, metavar=metavar, help=help)


def check_output(path: Path) -> None:
    """Raises ArgumentError where no file `path` can be, before the work that ends with it."""
    from cap4d.player.video import check_file

    check_file(path, "output")
