"""`cap4d rig`: import a head model, or look at one."""

from __future__ import annotations

import argparse
from pathlib import Path

from cap4d.commands.command import add_output, check_output, command


def add(commands) -> None:
    parser = command(
        commands,
        "rig",
        None,
        "import a head model, or look at one",
        "cap4d rig import ict FaceXModel -o ict.npz",
        more="A rig is a head mesh with identities, expressions and joints; track and fit need one.",
    )
    verbs = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_import(verbs)
    _add_show(verbs)


def _add_import(verbs) -> None:
    importer = command(
        verbs,
        "import",
        None,
        "make a rig .npz of a head model",
        "cap4d rig import builtin -o builtin.npz",
        more="Nothing in the model's files is executed. The rig keeps the licence of the model.",
    )
    kinds = importer.add_subparsers(title="head models", required=True, metavar="MODEL")
    builtin = ("the built-in head, which needs no file", "cap4d rig import builtin -o builtin.npz")
    for kind in (_add_flame(kinds), _add_ict(kinds), command(kinds, "builtin", run_import_builtin, *builtin)):
        add_output(kind, "RIG.npz", "rig to write; replaced if it exists")


def _add_flame(kinds) -> argparse.ArgumentParser:
    flame = command(
        kinds,
        "flame",
        run_import_flame,
        "a FLAME 2020 or 2023 pickle, read without executing anything in it",
        "cap4d rig import flame flame2023_no_jaw.pkl --assets cap4d/data/assets/flame -o flame.npz",
    )
    flame.add_argument("model", type=Path, metavar="MODEL.pkl", help="as downloaded from flame.is.tue.mpg.de")
    flame.add_argument(
        "--assets",
        type=Path,
        metavar="FOLDER",
        help="folder of the CAP4D assets (template, blink, jaw regressor, vertex lists)",
    )
    flame.add_argument(
        "--no-compat-pose-offset",
        dest="compat_pose_offset",
        action="store_false",
        help="leave out the constant offset of the released code's pose correctives (its fits expect it)",
    )
    return flame


def _add_ict(kinds) -> argparse.ArgumentParser:
    ict = command(
        kinds,
        "ict",
        run_import_ict,
        "ICT-FaceKit Light: a FaceXModel folder, or one packed .npz",
        "cap4d rig import ict FaceXModel -o ict.npz",
    )
    ict.add_argument("model", type=Path, metavar="FACEXMODEL", help="the folder, or the packed .npz")
    return ict


def _add_show(verbs) -> None:
    show = command(
        verbs,
        "show",
        run_show_rig,
        "draw a rig and each of its expressions",
        "cap4d rig show ict.npz -o ict.png",
    )
    show.add_argument("rig", type=Path, metavar="RIG.npz", help="made by `cap4d rig import`")
    show.add_argument(
        "--on", type=Path, metavar="CAPTURE", help="draw it over the first photo of a capture instead"
    )
    add_output(show, "PICTURE.png", "picture to write (default: beside the rig)", required=False)


def run_import_flame(arguments: argparse.Namespace) -> None:
    from cap4d.rig.flame import import_flame

    check_output(arguments.output)
    rig = import_flame(arguments.model, arguments.assets, compat_pose_offset=arguments.compat_pose_offset)
    write_rig(rig, arguments.output)


def run_import_ict(arguments: argparse.Namespace) -> None:
    from cap4d.rig.ict import import_ict

    check_output(arguments.output)
    write_rig(import_ict(arguments.model), arguments.output)


def run_import_builtin(arguments: argparse.Namespace) -> None:
    from cap4d.rig.builtin import build_head

    check_output(arguments.output)
    write_rig(build_head(), arguments.output)


def write_rig(rig, output: Path) -> None:
    from cap4d.rig.store import save_rig

    save_rig(rig, output)
    print(
        f"{output}: {rig.name} ({rig.licence}), {len(rig.template)} vertices, {len(rig.faces)} triangles, "
        f"{rig.n_identity} identity modes, {rig.n_expressions} expressions"
    )


def run_show_rig(arguments: argparse.Namespace) -> None:
    from cap4d.rig.store import load_rig

    output = arguments.output or arguments.rig.with_suffix(".png")
    check_output(output)
    rig = load_rig(arguments.rig)
    if arguments.on is None:
        from cap4d.rig.show import contact_sheet

        contact_sheet(rig, output)
    else:
        from cap4d.capture.capture import Capture
        from cap4d.capture.image import write_image
        from cap4d.track.overlay import draw_overlay

        capture = Capture.load(arguments.on)
        write_image(output, draw_overlay(capture, rig, capture.views[0]).astype("float32") / 255)
    print(f"{output}: {rig.name}, {len(rig.expression_names)} expressions: {', '.join(rig.expression_names)}")
