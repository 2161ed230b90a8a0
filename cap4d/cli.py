"""The `cap4d` command line: one function per command, imports inside. The device is chosen here.

Exit codes: 0 success, 1 bad data (one line: file, field, expected, found) or what the system refused, 2 a bad
argument or a missing package, 130 interrupted.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from cap4d.errors import exit_code
from cap4d.parser import OneLineParser

EXAMPLES = """examples:
  cap4d demo                                          # the built-in head, built once, then played
  cap4d demo --video me.mp4                           # the whole road from your video
  cap4d rig import ict FaceXModel -o ict.npz          # a head model (or: flame, builtin)
  cap4d track me.mp4 --rig ict.npz -o capture
  cap4d fit capture --rig ict.npz --preset low -o me.cap4d
  cap4d-view me.cap4d
"""
HELD_OUT = """held-out frames (every 10th and the last tenth of a video, or those the capture marks) are never
trained on; their expressions and poses come from the tracker, which sees all frames."""

OPTIMIZE = """Takes out what is not used, picks the cheapest deformer, stores numbers in fewer bits,
lowers the degree of the spherical harmonics and prunes Gaussians; each only while the pictures stay near
enough to those of the full avatar in float64. The error is the squared error pooled over frames of the
idle clip, from the default view and around it, on black and on white. Steps learn from other frames than
it is measured on."""

DRIVE = """The viewer listens: cap4d-view me.cap4d --drive tcp://127.0.0.1:9000. It may come and go; the
first frame waits for it. --impair makes the line worse, the same way for the same seed:

  loss=5%        frames that never arrive
  jitter=40ms    every frame is late by |x|, x normal with this deviation (at most 4 of them); in order
  reorder[=5%]   frames overtake one another, and these are held back by one to three frames besides
  duplicate=1%   arrive twice
  garbage=1%     have a message before them that is no frame"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arguments = build_parser().parse_args(argv)
    return exit_code("cap4d", lambda: arguments.run(arguments))


def build_parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="cap4d",
        description="Photos or a video of a person in, a live 4D avatar out.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    from cap4d import __version__

    parser.add_argument("--version", action="version", version=f"cap4d {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in (add_demo, add_rig, add_track, add_fit, add_optimize, add_render, add_drive):
        add(commands)
    for add in (add_inspect, add_bench):
        add(commands)
    return parser


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


# rig ----------------------------------------------------------------------------------------------


def add_rig(commands) -> None:
    parser = command(
        commands,
        "rig",
        None,
        "import a head model, or look at one",
        "cap4d rig import ict FaceXModel -o ict.npz",
        more="A rig is a head mesh with identities, expressions and joints; track and fit need one.",
    )
    verbs = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    importer = command(
        verbs,
        "import",
        None,
        "make a rig .npz of a head model",
        "cap4d rig import builtin -o builtin.npz",
        more="Nothing in the model's files is executed. The rig keeps the licence of the model.",
    )
    kinds = importer.add_subparsers(title="head models", required=True, metavar="MODEL")
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
    ict = command(
        kinds,
        "ict",
        run_import_ict,
        "ICT-FaceKit Light: a FaceXModel folder, or one packed .npz",
        "cap4d rig import ict FaceXModel -o ict.npz",
    )
    ict.add_argument("model", type=Path, metavar="FACEXMODEL", help="the folder, or the packed .npz")
    builtin = command(
        kinds,
        "builtin",
        run_import_builtin,
        "the built-in head, which needs no file",
        "cap4d rig import builtin -o builtin.npz",
    )
    for kind in (flame, ict, builtin):
        add_output(kind, "RIG.npz", "rig to write; replaced if it exists")
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
    add_rig_option(parser)
    add_output(
        parser,
        "CAPTURE",
        "folder to write: its parent must exist; an existing folder that is not empty is refused",
    )


def run_track(arguments: argparse.Namespace) -> None:
    from cap4d.rig.store import load_rig
    from cap4d.track import track
    from cap4d.track.footage import open_footage
    from cap4d.track.tracker import check_new_folder

    check_new_folder(arguments.output)
    open_footage(arguments.input)
    track(arguments.input, load_rig(arguments.rig), arguments.output)


def add_fit(commands) -> None:
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
        choices=("debug", "low"),
        help="debug: a minute; low: for CPUs, 256x256 (default: low)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint of an interrupted fit"
    )
    parser.add_argument("--ablate", choices=("unet",), help="leave a part out, to see what it is worth")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="same seed, same machine: same avatar (default: 0)"
    )


def run_fit(arguments: argparse.Namespace) -> None:
    from cap4d.avatar.fit import fit
    from cap4d.rig.store import load_rig

    check_output(arguments.output)
    fit(
        arguments.captures,
        load_rig(arguments.rig),
        arguments.output,
        preset=arguments.preset,
        resume=arguments.resume,
        ablate=arguments.ablate,
        seed=arguments.seed,
    )


# optimize -----------------------------------------------------------------------------------------


def add_optimize(commands) -> None:
    parser = command(
        commands,
        "optimize",
        run_optimize,
        "make an avatar's file smaller and its frames faster, to a stated error",
        "cap4d optimize me.cap4d --max-error 45dB -o small.cap4d",
        more=OPTIMIZE,
    )
    add_avatar(parser)
    parser.add_argument("--max-error", metavar="45dB", help="PSNR that the pictures must keep")
    parser.add_argument("--max-size", metavar="20MB", help="size that the file must have, at the least error")
    parser.add_argument(
        "--capture", type=Path, metavar="CAPTURE", help="look at the training views of this capture too"
    )
    add_output(parser, "SMALL.cap4d", "avatar to write; replaced if it exists, and never AVATAR itself")


def run_optimize(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.optimize.limit import parse_decibels, parse_size
    from cap4d.optimize.optimize import optimize
    from cap4d.optimize.report import table

    check_output(arguments.output)
    report = optimize(
        arguments.avatar,
        arguments.output,
        max_error_db=None if arguments.max_error is None else parse_decibels(arguments.max_error),
        max_bytes=None if arguments.max_size is None else parse_size(arguments.max_size),
        capture=arguments.capture,
    )
    print(table(report))


# render, inspect ----------------------------------------------------------------------------------


def add_render(commands) -> None:
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


def add_drive(commands) -> None:
    parser = command(
        commands,
        "drive",
        run_drive,
        "send a source to a viewer, in real time",
        "cap4d drive speech.npy --to tcp://127.0.0.1:9000 --impair loss=5%,jitter=40ms,reorder",
        more=DRIVE,
    )
    parser.add_argument(
        "source",
        metavar="SRC",
        help="fit.npz, vertices .npy, Live Link Face .csv, avatar.cap4d (its idle clip), - (NDJSON)",
    )
    parser.add_argument(
        "--to", required=True, metavar="URL", help="tcp://, udp://, ws:// or livelink://HOST:PORT, or -"
    )
    parser.add_argument("--impair", metavar="LIST", help="make the line worse, see above")
    parser.add_argument(
        "--fps", type=float, metavar="N", help="frames per second of the source, whatever it says itself"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="times as fast as recorded (default: 1)"
    )
    parser.add_argument("--loop", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument(
        "--as",
        dest="form",
        choices=("expr", "arkit", "vertices"),
        help="how frames are said (default: as the file has them)",
    )
    parser.add_argument(
        "--avatar", type=Path, metavar="AVATAR.cap4d", help="of the source's rig, to translate for --as"
    )
    parser.add_argument(
        "--template", type=Path, metavar="FILE", help="neutral vertices of an .npy, to translate it"
    )
    parser.add_argument("--token", metavar="X", help="what the viewer asks for")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="same seed: the same frames suffer (default: 0)"
    )


def run_drive(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.drive.send import Transmission, send

    send(Transmission(**{name: value for name, value in vars(arguments).items() if name != "run"}))


def add_inspect(commands) -> None:
    parser = command(
        commands, "inspect", run_inspect, "say what is in a .cap4d file", "cap4d inspect me.cap4d"
    )
    add_avatar(parser)


def run_inspect(arguments: argparse.Namespace) -> None:
    from cap4d.bundle.inspect import describe

    print(describe(arguments.avatar))


# bench --------------------------------------------------------------------------------------------


def add_bench(commands) -> None:
    parser = command(
        commands,
        "bench",
        run_bench,
        "measure speed against error, and write a report",
        "cap4d bench --report bench --avatar me.cap4d",
        more="Splatter, fitting step, deformer and whole frames, beside the machine's ceilings and peers.",
    )
    parser.add_argument(
        "--report",
        type=Path,
        default=Path("bench"),
        metavar="FOLDER",
        help="for report.md, report.json and plots; made when missing (default: bench)",
    )
    parser.add_argument(
        "--scenes",
        type=Path,
        metavar="FOLDER",
        help="head_30k.npz ... bad_100k.npz and cameras.json (default: the package's own scenes)",
    )
    parser.add_argument(
        "--avatar",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="avatars for the deformer and whole frames (default: none, and those sections are left out)",
    )
    parser.add_argument(
        "--only",
        metavar="SECTIONS",
        help="some of ceilings,splat,fit,deformer,frame,optimize,peers (default: all)",
    )
    parser.add_argument("--threads", type=int, default=2, metavar="N", help="of everything (default: 2)")
    parser.add_argument("--quick", action="store_true", help="small and short: to see that it runs")


def run_bench(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.errors import ArgumentError
    from cap4d.evaluate.bench.run import bench, parse_sections
    from cap4d.evaluate.bench.settings import SECTIONS, Settings

    if not 1 <= arguments.threads <= 256:
        raise ArgumentError(f"threads: expected 1 to 256, got {arguments.threads}")
    settings = Settings(
        sections=SECTIONS if arguments.only is None else parse_sections(arguments.only),
        threads=arguments.threads,
        quick=arguments.quick,
        avatars=tuple(arguments.avatar),
        scenes=arguments.scenes,
    )
    bench(arguments.report, settings)


if __name__ == "__main__":
    sys.exit(main())
