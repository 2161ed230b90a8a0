"""`cap4d demo`: the whole road in one command."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import command


def add(commands) -> None:
    parser = command(
        commands,
        "demo",
        run_demo,
        "build (once) and play an avatar: the built-in head, or one made from your video",
        "cap4d demo --video me.mp4 --rig ict.npz",
    )
    parser.add_argument(
        "--video",
        type=Path,
        metavar="VIDEO",
        help="make the avatar from this video instead of the built-in head",
    )
    parser.add_argument(
        "--rig",
        type=Path,
        metavar="RIG.npz",
        help="head model for --video, made by `cap4d rig import` (default: the built-in head)",
    )
    parser.add_argument(
        "--preset", default="low", choices=("debug", "low"), help="fit settings for --video (default: low)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out"),
        metavar="FOLDER",
        help="for what the demo writes; made when missing (default: out)",
    )


def run_demo(arguments: argparse.Namespace) -> int:
    from cap4d import demo

    if arguments.video is None:
        avatar = demo.demo_avatar_path()
    else:
        rig = load_rig_or_builtin(arguments.rig)
        avatar = demo.avatar_from_video(arguments.video, rig, arguments.out, preset=arguments.preset)
    return demo.play(avatar, arguments.out)


def load_rig_or_builtin(path: Path | None):
    from cap4d.rig.builtin import build_head
    from cap4d.rig.store import load_rig

    return build_head() if path is None else load_rig(path)
