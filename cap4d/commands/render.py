"""`cap4d render`: an avatar driven by a file, on the CPU."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cap4d.commands.command import add_avatar, command


def add(commands) -> None:
    parser = command(
        commands,
        "render",
        run_render,
        "draw an avatar driven by a file, on the CPU",
        "cap4d render me.cap4d --drive fit.npz --camera orbit -o out.mp4",
    )
    add_avatar(parser)
    parser.add_argument(
        "--drive", metavar="SRC", help="fit.npz or vertices .npy (default: the avatar's idle clip)"
    )
    parser.add_argument(
        "--template", type=Path, metavar="FILE", help="neutral vertices for an .npy (.npy, .npz or .obj)"
    )
    parser.add_argument(
        "--fps", type=float, metavar="N", help="frames per second of the source, whatever it says itself"
    )
    parser.add_argument(
        "--camera", default="static", metavar="static|orbit|FILE", help="camera path (default: static)"
    )
    parser.add_argument(
        "--deformer",
        default="auto",
        choices=("auto", "full", "fp16", "int8", "linear", "off"),
        help="how the deformation network is evaluated, as far as the avatar has it (cap4d inspect); auto: "
        "the most exact (default: auto)",
    )
    parser.add_argument("--size", default="512x512", metavar="WxH", help="picture (default: 512x512)")
    parser.add_argument("--frames", type=int, metavar="N", help="how many (default: the whole clip, once)")
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="out.mp4, frame_%%04d.png or one.png"
    )
    parser.add_argument(
        "--pipeline", action="store_true", help="work out the next frame's face while a frame is drawn"
    )
    parser.add_argument("--audio", type=Path, metavar="FILE.wav", help="the sound of out.mp4")
    parser.add_argument("--stats", type=Path, metavar="FILE", help="write times per stage to this JSON file")


def run_render(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.player.offline import render_file

    render_file(
        arguments.avatar,
        arguments.output,
        drive=arguments.drive,
        template=arguments.template,
        fps=arguments.fps,
        camera=arguments.camera,
        size=arguments.size,
        frames=arguments.frames,
        stats=arguments.stats,
        deformer=arguments.deformer,
        pipelined=arguments.pipeline,
        audio=arguments.audio,
    )
