"""`cap4d fit`: captures become an avatar."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import add_output, add_rig_option, check_output, command

HELD_OUT = """held-out frames (every 10th and the last tenth of a video, or those the capture marks) are never
trained on; their expressions and poses come from the tracker, which sees all frames."""

RECIPE = """released: the constants of the released CAP4D code; paper: the paper's, where it differs; short:
for CPUs; auto: released where torch finds a CUDA device, short elsewhere (default: auto)"""


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
        choices=("default", "medium", "low", "debug"),
        help="debug: a minute; low: for CPUs, 256x256; medium, default: longer and finer (default: low)",
    )
    parser.add_argument(
        "--recipe", default="auto", choices=("auto", "released", "paper", "short"), help=RECIPE
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint of an interrupted fit"
    )
    parser.add_argument(
        "--ablate",
        choices=("unet", "lpips", "remesh", "mmdm"),
        help="leave a part out, to see what it is worth: the deformation network, the perceptual term, the "
        "UV grid together with the network, or all captures but the first",
    )
    add_reference_options(parser)
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="same seed, same machine: same avatar (default: 0)"
    )
    _add_choices(parser)


def _add_choices(parser: argparse.ArgumentParser) -> None:
    """What may be chosen apart from the recipe, which decides where nothing is said."""
    group = parser.add_argument_group("options apart from the recipe")
    group.add_argument(
        "--perceptual",
        choices=("none", "lpips", "gradient"),
        help="a further comparison of images; lpips needs weights, gradient is a stand-in without any",
    )
    group.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="DIR",
        help="folder with vgg16-397923af.pth and vgg.pth (default: torch hub's cache)",
    )
    group.add_argument(
        "--lpips-range",
        choices=("fixed", "compat"),
        help="show LPIPS images in [-1, 1], or in [0, 1] as the released code does (default: fixed)",
    )
    group.add_argument(
        "--split-offset",
        choices=("local", "world"),
        help="units of the offset of a split Gaussian's children; world: as the released code",
    )
    group.add_argument(
        "--per-face", type=int, choices=(0, 1, 2), help="Gaussians that every triangle has at least"
    )
    group.add_argument(
        "--prune",
        choices=("opacity", "contribution"),
        help="contribution: of those that stay, take out what the training images would miss least",
    )


def add_reference_options(parser: argparse.ArgumentParser) -> None:
    """What is trained on, where it is not everything."""
    parser.add_argument(
        "--references",
        metavar="N|FILE.json",
        help="train on so many images of the first capture, chosen by view and expression, or on those that "
        "a file lists as [[camera, frame], ...] (default: all that are not held out)",
    )
    parser.add_argument(
        "--reference-seed",
        type=int,
        default=0,
        metavar="S",
        help="another choice of N images, from a random half (default: 0, from all)",
    )
    parser.add_argument(
        "--hold-out-cameras",
        metavar="A,B",
        help="cameras of the first capture that are never trained on (default: none)",
    )


def chosen_references(arguments: argparse.Namespace, rig, hold_out: tuple[str, ...]):
    """(camera, frame) pairs, or None for all."""
    from cap4d.avatar.references import choose_references, read_references
    from cap4d.capture.capture import Capture

    wanted = arguments.references
    if wanted is None:
        return None
    capture = Capture.load(arguments.captures[0])
    if not wanted.lstrip("-").isdecimal():
        return read_references(Path(wanted), capture)
    return choose_references(capture, rig, int(wanted), hold_out=hold_out, seed=arguments.reference_seed)


def run_fit(arguments: argparse.Namespace) -> None:
    from cap4d.avatar.fit import fit
    from cap4d.avatar.presets import Choices, preset_named
    from cap4d.rig.store import load_rig

    check_output(arguments.output)
    choices = Choices(
        perceptual=arguments.perceptual,
        lpips_range=arguments.lpips_range,
        split_offset=arguments.split_offset,
        per_face=arguments.per_face,
        prune=arguments.prune,
    )
    rig = load_rig(arguments.rig)
    hold_out = tuple(filter(None, (arguments.hold_out_cameras or "").split(",")))
    fit(
        arguments.captures,
        rig,
        arguments.output,
        preset=choices.applied(preset_named(arguments.preset, recipe_of(arguments.recipe))),
        resume=arguments.resume,
        ablate=arguments.ablate,
        seed=arguments.seed,
        lpips_weights=arguments.lpips_weights,
        references=chosen_references(arguments, rig, hold_out),
        hold_out=hold_out,
    )


def recipe_of(name: str) -> str:
    """`auto` becomes `released` or `short`."""
    if name != "auto":
        return name
    import torch

    return "released" if torch.cuda.is_available() else "short"
