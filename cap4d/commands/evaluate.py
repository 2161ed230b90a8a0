"""`cap4d evaluate`: how near an avatar comes to a capture."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import add_avatar, add_output, check_output, command

EVALUATE = """The avatar is driven by the capture's own expressions, gaze, neck and head pose, seen by its own
cameras, on white, and compared with its images: PSNR, LPIPS, SSIM, CSIM, JOD, AED, APD and AKD, errors of
gaze and blink, and AED-mp and APD-mp, which need no weights. Metrics whose network is not there say what
they need. Numbers per view, and what each metric is, go to the report."""


def add(commands) -> None:
    parser = command(
        commands,
        "evaluate",
        run_evaluate,
        "measure how near an avatar comes to a capture",
        "cap4d evaluate me.cap4d capture --held-out -o report.json",
        more=EVALUATE,
    )
    add_avatar(parser)
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder of the same rig")
    add_output(parser, "REPORT.json", "file for all numbers", required=False)
    _add_views(parser)
    _add_weights(parser)


def _add_views(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cameras", metavar="A,B", help="names of cameras (default: all)")
    parser.add_argument("--frames", metavar="0:100:2", help="first, end and step of frames (default: all)")
    parser.add_argument(
        "--held-out", action="store_true", help="only frames that a fit of this capture holds out"
    )
    parser.add_argument("--metrics", metavar="A,B", help="names of metrics (default: all)")
    parser.add_argument("--size", type=int, metavar="N", help="px of the larger side (default: the images')")
    parser.add_argument(
        "--deformer",
        default="auto",
        choices=("auto", "full", "fp16", "int8", "linear", "off"),
        help="as of cap4d render (default: auto, the most exact)",
    )
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="folder for the avatar's pictures and a sheet.png"
    )


def _add_weights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--lpips-weights", type=Path, metavar="DIR", help="LPIPS's two files (default: torch hub's cache)"
    )
    parser.add_argument("--arcface", type=Path, metavar="FILE.onnx", help="ArcFace, for CSIM")
    parser.add_argument("--fan", type=Path, metavar="FILE.onnx", help="FAN, for AKD-fan")
    parser.add_argument("--flame-regressor", type=Path, metavar="FILE.onnx", help="DECA or SMIRK: AED, APD")


def run_evaluate(arguments: argparse.Namespace) -> None:
    from cap4d.capture.capture import Capture
    from cap4d.evaluate.evaluate import evaluate
    from cap4d.evaluate.metrics.weights import Weights
    from cap4d.evaluate.views import parse_frames, select_views

    if arguments.output is not None:
        check_output(arguments.output)
    views = select_views(
        Capture.load(arguments.capture),
        cameras=_names(arguments.cameras),
        frames=None if arguments.frames is None else parse_frames(arguments.frames),
        held_out=arguments.held_out,
    )
    evaluation = evaluate(
        arguments.avatar,
        arguments.capture,
        views=views,
        weights=Weights(
            lpips=arguments.lpips_weights,
            arcface=arguments.arcface,
            fan=arguments.fan,
            flame=arguments.flame_regressor,
        ),
        only=_names(arguments.metrics),
        size=arguments.size,
        deformer=arguments.deformer,
        pictures=arguments.pictures,
    )
    if arguments.output is not None:
        evaluation.write(arguments.output)
    print(evaluation.table())


def _names(text: str | None) -> list[str] | None:
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]
