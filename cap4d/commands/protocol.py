"""`cap4d protocol`: the paper's tables."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import add_rig_option, command

SELF = """One cell of the table is a fit and its evaluation on cameras that no fit saw. Finished cells are
kept in FOLDER/cells and found again by a digest of all that shapes them, so a stopped run goes on where it
was, and an option that changes makes what it changes. A cell that fails is reported at the end; the others
are there. Written: report.json, table.md (the paper's layout, and paired gains), page.html and page.png. The
paper's own counts are 9 identities, 4 held-out cameras x 100 frames at 512 px."""

CROSS = """There is no ground truth: nobody knows how the avatar's person would look. Measured are identity
(CSIM, against the avatar's own face at rest) and whether expression, gaze, lids and head do what the
driver's do, as the same estimator sees both pictures. Numbers that compare pixels with the driver's would
reward looking like the driver, and are left out. Written: report.json, table.md, page.html and page.png."""


def add(commands) -> None:
    parser = command(
        commands,
        "protocol",
        None,
        "make the paper's tables: many fits, and what each is worth",
        "cap4d protocol self-reenactment ann bob --rig ict.npz --ablate none,unet -o table",
    )
    kinds = parser.add_subparsers(title="protocols", required=True, metavar="PROTOCOL")
    _add_self(kinds)
    _add_cross(kinds)


def _add_self(kinds) -> None:
    parser = command(
        kinds,
        "self-reenactment",
        run_self,
        "avatars from few and many images, judged from held-out cameras",
        "cap4d protocol self-reenactment ann bob --rig ict.npz --ablate none,unet --preset debug -o table",
        more=SELF,
    )
    parser.add_argument(
        "captures",
        type=Path,
        nargs="+",
        metavar="CAPTURE",
        help="several cameras' images, one folder a person",
    )
    add_rig_option(parser)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="made when missing; gone on with"
    )
    parser.add_argument(
        "--references", default="1,10,100", metavar="N,N,...", help="how many images (default: 1,10,100)"
    )
    parser.add_argument(
        "--ablate",
        default="none",
        metavar="A,B,...",
        help="methods: none (all of ours), and what is left out: unet, lpips, remesh (GaussianAvatars), mmdm "
        "(all generated views) (default: none)",
    )
    add_fit_options(parser)
    parser.add_argument(
        "--hold-out-cameras",
        default="4",
        metavar="N|A,B",
        help="so many of those in front, from side to side, or by name (default: 4)",
    )
    parser.add_argument(
        "--frames", type=int, metavar="N", help="judge so many frames of each held-out camera (default: all)"
    )
    parser.add_argument(
        "--size", type=int, metavar="PX", help="judge at this size (default: the preset's image size)"
    )
    parser.add_argument(
        "--generated",
        type=Path,
        metavar="FOLDER",
        help="captures generated from the references, FOLDER/<capture's name>/<N> (default: none)",
    )
    parser.add_argument(
        "--reference-seed", type=int, default=0, metavar="S", help="another choice of references (default: 0)"
    )
    add_judge_options(parser)


def _add_cross(kinds) -> None:
    parser = command(
        kinds,
        "cross-reenactment",
        run_cross,
        "avatars driven by other people",
        "cap4d protocol cross-reenactment ann.cap4d --drive bob carl -o cross",
        more=CROSS,
    )
    parser.add_argument("avatars", type=Path, nargs="+", metavar="AVATAR.cap4d", help="made by `cap4d fit`")
    parser.add_argument(
        "--drive",
        type=Path,
        nargs="+",
        required=True,
        metavar="CAPTURE",
        help="other people, on the same rig",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="made when missing; gone on with"
    )
    parser.add_argument(
        "--frames", type=int, default=20, metavar="N", help="of each driver, evenly (default: 20)"
    )
    parser.add_argument(
        "--size", type=int, default=256, metavar="PX", help="of the pictures that are judged (default: 256)"
    )
    for name, what in WEIGHTS.items():
        if name in ("arcface", "flame-regressor"):
            parser.add_argument(f"--{name}", type=Path, metavar="PATH", help=what)


def run_cross(arguments: argparse.Namespace) -> None:
    from cap4d.evaluate.metrics.weights import Weights
    from cap4d.evaluate.protocols.cross_reenactment import Cross, cross_reenactment

    weights = Weights(arcface=arguments.arcface, flame=arguments.flame_regressor)
    cross = Cross(frames=arguments.frames, size=arguments.size, weights=weights)
    cross_reenactment(arguments.avatars, arguments.drive, arguments.output, cross)
    print((arguments.output / "table.md").read_text(encoding="utf-8"))


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """What shapes every fit."""
    parser.add_argument("--preset", default="debug", metavar="P", help="of every fit (default: debug)")
    parser.add_argument(
        "--recipe",
        default="auto",
        choices=("auto", "released", "paper", "short"),
        help="as of cap4d fit (default: auto)",
    )
    parser.add_argument("--steps", type=int, metavar="N", help="fit for so many steps, not the preset's")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of every fit (default: 0)")


def add_judge_options(parser: argparse.ArgumentParser) -> None:
    """What avatars are judged by."""
    parser.add_argument("--metrics", metavar="A,B", help="some of those of `cap4d evaluate` (default: all)")
    for name, what in WEIGHTS.items():
        parser.add_argument(f"--{name}", type=Path, metavar="PATH", help=what)


WEIGHTS = {
    "lpips-weights": "folder with LPIPS's two files (default: torch hub's cache)",
    "arcface": "ArcFace as ONNX, for CSIM",
    "fan": "FAN as ONNX, for AKD-fan",
    "flame-regressor": "DECA or SMIRK as ONNX, for AED and APD",
}


def run_self(arguments: argparse.Namespace) -> None:
    from cap4d.evaluate.protocols.self_reenactment import Protocol, self_reenactment

    judge, judged_by = _judge(arguments)
    wanted = arguments.hold_out_cameras
    protocol = Protocol(
        preset=_preset(arguments),
        references=tuple(_counts("references", arguments.references)),
        methods=_names(arguments.ablate),
        hold_out=int(wanted) if wanted.isdecimal() else _names(wanted),
        frames=arguments.frames,
        size=arguments.size,
        generated=arguments.generated,
        seed=arguments.seed,
        reference_seed=arguments.reference_seed,
        lpips_weights=arguments.lpips_weights,
    )
    self_reenactment(
        arguments.captures, arguments.rig, arguments.output, protocol, judge=judge, judged_by=judged_by
    )
    print((arguments.output / "table.md").read_text(encoding="utf-8"))


def _preset(arguments: argparse.Namespace):
    from dataclasses import replace

    from cap4d.avatar.presets import preset_named
    from cap4d.commands.fit import recipe_of
    from cap4d.errors import ArgumentError

    preset = preset_named(arguments.preset, recipe_of(arguments.recipe))
    if arguments.steps is None:
        return preset
    if arguments.steps < 1:
        raise ArgumentError(f"steps: expected at least 1, got {arguments.steps}")
    return replace(preset, iterations=arguments.steps)


def _judge(arguments: argparse.Namespace):
    from cap4d.evaluate.metrics.weights import Weights
    from cap4d.evaluate.protocols.judge import judge_by_metrics

    weights = Weights(
        lpips=arguments.lpips_weights,
        arcface=arguments.arcface,
        fan=arguments.fan,
        flame=arguments.flame_regressor,
    )
    return judge_by_metrics(weights, _names(arguments.metrics) if arguments.metrics else None)


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(filter(None, (name.strip() for name in text.split(",")))))


def _counts(name: str, text: str) -> list[int]:
    from cap4d.errors import ArgumentError

    parts = _names(text)
    if not parts or not all(part.isdecimal() for part in parts):
        raise ArgumentError(f"{name}: expected numbers with commas between, got {text!r}")
    return sorted({int(part) for part in parts})
