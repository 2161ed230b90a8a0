"""The `cap4d` command line: one function per command, imports inside. The device is chosen here.

Exit codes: 0 success, 1 bad data (one line: file, field, expected, found), 2 a bad argument, 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from cap4d.errors import exit_code

EXAMPLES = """examples:
  cap4d demo                                          # the built-in head, built once, then played
  cap4d demo --video me.mp4                           # the whole road from your video
  cap4d rig import ict FaceXModel -o ict.npz          # a head model (or: flame, builtin)
  cap4d track me.mp4 --rig ict.npz -o capture
  cap4d fit capture --rig ict.npz --preset low -o me.cap4d
  cap4d-view me.cap4d
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arguments = build_parser().parse_args(argv)
    return exit_code("cap4d", lambda: arguments.run(arguments))


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cap4d",
        description="Photos or a video of a person in, a live 4D avatar out.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    from cap4d import __version__

    parser.add_argument("--version", action="version", version=f"cap4d {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in (add_demo, add_rig, add_track, add_fit, add_render, add_inspect):
        add(commands)
    return parser


def command(commands, name: str, run: Callable, help: str, example: str) -> argparse.ArgumentParser:
    """A subparser with the house's layout: what it does, its options, an example."""
    parser = commands.add_parser(
        name,
        help=help,
        description=help[0].upper() + help[1:] + ".",
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


# demo ---------------------------------------------------------------------------------------------


def add_demo(commands) -> None:
    parser = command(
        commands,
        "demo",
        run_demo,
        "build (once) and play an avatar: the built-in head, or one made from your video",
        "cap4d demo --video me.mp4 --rig ict.npz",
    )
    parser.add_argument(
        "--video", type=Path, help="make the avatar from this video instead of the built-in head"
    )
    parser.add_argument(
        "--rig", type=Path, help="head model for --video (a rig .npz; default: the built-in head)"
    )
    parser.add_argument(
        "--preset", default="low", choices=("debug", "low"), help="fit settings for --video (default: low)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out"), help="folder for what the demo writes (default: out)"
    )


def run_demo(arguments: argparse.Namespace) -> int:
    from cap4d import demo

    if arguments.video is None:
        avatar = demo.demo_avatar_path()
    else:
        rig = load_rig_or_builtin(arguments.rig)
        avatar = demo.avatar_from_video(arguments.video, rig, arguments.out, preset=arguments.preset)
    return demo.play(avatar, arguments.out)


# rig ----------------------------------------------------------------------------------------------


def add_rig(commands) -> None:
    parser = commands.add_parser("rig", help="import or look at a head model")
    verbs = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    kinds = verbs.add_parser("import", help="make a rig .npz of a head model").add_subparsers(
        title="head models", required=True, metavar="MODEL"
    )
    flame = command(
        kinds,
        "flame",
        run_import_flame,
        "a FLAME 2020 or 2023 pickle, read without executing anything in it",
        "cap4d rig import flame flame2023_no_jaw.pkl --assets cap4d/data/assets/flame -o flame.npz",
    )
    flame.add_argument("model", type=Path, metavar="MODEL.pkl")
    flame.add_argument(
        "--assets",
        type=Path,
        help="folder of the CAP4D assets (template, blink, jaw regressor, vertex lists)",
    )
    flame.add_argument(
        "--no-compat-pose-offset",
        dest="compat_pose_offset",
        action="store_false",
        help="leave out the constant offset of the released code's pose correctives (its fits expect it)",
    )
    ict = command(
        kinds,
        "ict",
        run_import_ict,
        "ICT-FaceKit Light: a FaceXModel folder, or one packed .npz",
        "cap4d rig import ict FaceXModel -o ict.npz",
    )
    ict.add_argument("model", type=Path, metavar="FACEXMODEL")
    builtin = command(
        kinds,
        "builtin",
        run_import_builtin,
        "the built-in head, which needs no file",
        "cap4d rig import builtin -o builtin.npz",
    )
    for kind in (flame, ict, builtin):
        kind.add_argument("-o", "--output", type=Path, required=True, metavar="RIG.npz")
    show = command(
        verbs,
        "show",
        run_show_rig,
        "draw a rig and each of its expressions",
        "cap4d rig show ict.npz -o ict.png",
    )
    show.add_argument("rig", type=Path, metavar="RIG.npz")
    show.add_argument(
        "--on", type=Path, metavar="CAPTURE", help="draw it over the first photo of a capture instead"
    )
    show.add_argument("-o", "--output", type=Path, help="PNG to write (default: beside the rig)")


def run_import_flame(arguments: argparse.Namespace) -> None:
    from cap4d.rig.flame import import_flame

    rig = import_flame(arguments.model, arguments.assets, compat_pose_offset=arguments.compat_pose_offset)
    write_rig(rig, arguments.output)


def run_import_ict(arguments: argparse.Namespace) -> None:
    from cap4d.rig.ict import import_ict

    write_rig(import_ict(arguments.model), arguments.output)


def run_import_builtin(arguments: argparse.Namespace) -> None:
    from cap4d.rig.builtin import build_head

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

    rig = load_rig(arguments.rig)
    output = arguments.output or arguments.rig.with_suffix(".png")
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


def load_rig_or_builtin(path: Path | None):
    from cap4d.rig.builtin import build_head
    from cap4d.rig.store import load_rig

    return build_head() if path is None else load_rig(path)


# track, fit ---------------------------------------------------------------------------------------


def add_track(commands) -> None:
    parser = command(
        commands,
        "track",
        run_track,
        "turn a video or a folder of photos into a capture",
        "cap4d track me.mp4 --rig ict.npz -o capture",
    )
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="a video, an image, or a folder of images of one person"
    )
    parser.add_argument("--rig", type=Path, required=True, metavar="RIG.npz")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="CAPTURE", help="folder to write; must not exist"
    )


def run_track(arguments: argparse.Namespace) -> None:
    from cap4d.rig.store import load_rig
    from cap4d.track import track

    track(arguments.input, load_rig(arguments.rig), arguments.output)


def add_fit(commands) -> None:
    parser = command(
        commands,
        "fit",
        run_fit,
        "fit an avatar to one or more captures of a person",
        "cap4d fit capture --rig ict.npz --preset low -o me.cap4d",
    )
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--rig", type=Path, required=True, metavar="RIG.npz")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="AVATAR.cap4d")
    parser.add_argument(
        "--preset", default="low", choices=("debug", "low"), help="debug: a minute; low: for CPUs, 256x256"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint of an interrupted fit"
    )
    parser.add_argument("--ablate", choices=("unet",), help="leave a part out, to see what it is worth")
    parser.add_argument("--seed", type=int, default=0)


def run_fit(arguments: argparse.Namespace) -> None:
    from cap4d.avatar.fit import fit
    from cap4d.rig.store import load_rig

    fit(
        arguments.captures,
        load_rig(arguments.rig),
        arguments.output,
        preset=arguments.preset,
        resume=arguments.resume,
        ablate=arguments.ablate,
        seed=arguments.seed,
    )


# render, inspect ----------------------------------------------------------------------------------


def add_render(commands) -> None:
    parser = command(
        commands,
        "render",
        run_render,
        "draw an avatar driven by a file, on the CPU",
        "cap4d render me.cap4d --drive fit.npz --camera orbit -o out.mp4",
    )
    parser.add_argument("avatar", type=Path, metavar="AVATAR.cap4d")
    parser.add_argument(
        "--drive", metavar="SRC", help="fit.npz or vertices .npy (default: the avatar's idle clip)"
    )
    parser.add_argument("--template", type=Path, help="neutral vertices of a .npy stream")
    parser.add_argument("--fps", type=float, help="rate of a source that does not say its own")
    parser.add_argument("--camera", default="static", metavar="static|orbit|FILE")
    parser.add_argument("--size", default="512x512", metavar="WxH")
    parser.add_argument("--frames", type=int, help="default: the whole clip, once")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.mp4|FRAME_%04d.png")
    parser.add_argument("--stats", type=Path, help="write times per stage to this JSON file")


def run_render(arguments: argparse.Namespace) -> None:
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
    )


def add_inspect(commands) -> None:
    parser = command(
        commands, "inspect", run_inspect, "say what is in a .cap4d file", "cap4d inspect me.cap4d"
    )
    parser.add_argument("avatar", type=Path, metavar="AVATAR.cap4d")


def run_inspect(arguments: argparse.Namespace) -> None:
    from cap4d.bundle.inspect import describe

    print(describe(arguments.avatar))


if __name__ == "__main__":
    sys.exit(main())
