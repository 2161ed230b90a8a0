"""`cap4d inspect`: what is in a file."""

from __future__ import annotations

import argparse

from cap4d.commands.command import add_avatar, command


def add(commands) -> None:
    parser = command(
        commands, "inspect", run_inspect, "say what is in a .cap4d file", "cap4d inspect me.cap4d"
    )
    add_avatar(parser)


def run_inspect(arguments: argparse.Namespace) -> None:
    from cap4d.bundle.inspect import describe

    print(describe(arguments.avatar))
