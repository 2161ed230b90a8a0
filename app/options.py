"""The command line of `cap4d-view`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cap4d.errors import ArgumentError
from cap4d.parser import OneLineParser

EXAMPLES = """examples:
  cap4d-view                                   the built-in demo avatar, in a window
  cap4d-view me.cap4d                          drag turns, right drag (or shift) pans, the wheel zooms
  cap4d-view me.cap4d --drive fit.npz          driven by a FlowFace sequence
  cap4d-view me.cap4d --drive speech.npy --template neutral.npy --fps 30
  cap4d-view me.cap4d --headless --frames 120 --out out.mp4 --stats stats.json
  cap4d-view me.cap4d --headless --camera orbit --out frame_%04d.png
  cap4d-view me.cap4d --drive speech.npy --audio speech.wav --out speech.mp4
  cap4d-view me.cap4d --serve                  a page for a browser on this machine
  cap4d-view me.cap4d --serve 0.0.0.0:8300     for others too: to whom you give the address and its token

keys: space pause, left/right step a frame, r reset the camera, h hide the panels, F1 all keys, q quit
"""


DRIVE_HELP = (
    "fit.npz, vertices .npy or Live Link Face .csv; or live: - (lines of JSON), tcp://, udp:// or "
    "ws://HOST:PORT, livelink://, vmc://, webcam://0 (default: the avatar's idle clip)"
)
PICTURE = 512, 512  # px, where no size is asked for
DEFORMERS = ("auto", "full", "fp16", "int8", "linear", "off")
FPS_HELP = "frames per second of the source, whatever it says itself (live, headless: of the file)"
DEFORMER_HELP = (
    "how the deformation network is evaluated, as far as the avatar has it (cap4d inspect); auto: the most "
    "exact, in a window the most exact that takes at most 8 ms a frame on this machine (default: auto)"
)
SERVE = "127.0.0.1:8300"

Add = Callable[..., argparse.Action]  # `ArgumentParser.add_argument`


@dataclass(frozen=True)
class Options:
    """What was asked for. `None` leaves the choice to the program; see `build_parser` for each."""

    avatar: Path | None
    drive: str | None
    template: Path | None
    fps: float | None
    backend: str
    deformer: str
    size: tuple[int, int] | None
    headless: bool
    pipeline: bool
    frames: int | None
    out: str | None
    camera: str
    blink: bool
    gaze: bool
    neck: bool
    sender: Path | None
    audio: Path | None
    stats: Path | None
    serve: str | None
    token: str | None

    @property
    def fill(self) -> dict[str, bool]:
        """Which fillers of a live source there are to be; see `Fillers`."""
        return {"blink": self.blink, "gaze": self.gaze, "neck": self.neck}

    @property
    def driving(self) -> dict[str, Any]:
        """How `drive` is opened; see `open_playback`."""
        return {"template": self.template, "fps": self.fps, "sender": self.sender, "fill": self.fill}

    @property
    def picture_size(self) -> tuple[int, int]:
        """(width, height) px of a picture without a window."""
        return self.size or PICTURE


def parse_options(argv: Sequence[str] | None = None) -> Options:
    """Exits with code 2 and one line on a bad argument, with 0 after `--help`."""
    options = Options(**vars(build_parser().parse_args(argv)))
    if options.avatar is None and options.serve is not None and ":" not in options.serve:
        return replace(options, avatar=Path(options.serve), serve=SERVE)  # `--serve me.cap4d`
    return options


def build_parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="cap4d-view",
        description="Plays a 4D avatar live in a window, or renders it to a file.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_source(parser.add_argument)
    _add_pictures(parser.add_argument)
    _add_page(parser.add_argument)
    return parser


def _add_source(add: Add) -> None:
    """Who plays, and what drives them."""
    add("avatar", nargs="?", type=Path, metavar="AVATAR.cap4d", help="default: the built-in demo avatar")
    add("--drive", metavar="SRC", help=DRIVE_HELP)
    add(
        "--template",
        type=Path,
        metavar="FILE",
        help="neutral vertices for an .npy (.npy, .npz or .obj)",
    )
    add(
        "--sender",
        type=Path,
        metavar="RIG.npz",
        help="rig of a live sender of another edition of FLAME than the avatar's (cap4d rig import flame)",
    )
    add("--no-blink", dest="blink", action="store_false", help="no blinks where a live source has none")
    add("--no-gaze", dest="gaze", action="store_false", help="no glances where a live source has none")
    add("--no-neck", dest="neck", action="store_false", help="no breathing neck where a live source has none")
    add("--fps", type=_rate, help=FPS_HELP)


def _add_pictures(add: Add) -> None:
    """How it is drawn, and where to."""
    add("--backend", choices=("auto", "gl", "cpu"), default="auto", help="auto: gl where there is a GPU")
    add("--deformer", choices=DEFORMERS, default="auto", help=DEFORMER_HELP)
    add("--size", type=_size, metavar="WxH", help="picture (default: 512x512), or window")
    add("--headless", action="store_true", help="no window: render to --out")
    add(
        "--pipeline",
        action="store_true",
        help="headless on the cpu: work out the next frame's face while a frame is drawn",
    )
    add(
        "--frames", type=_count, metavar="N", help="stop after N frames (headless: default is the clip, once)"
    )
    add("--out", metavar="FILE", help="out.mp4, frame_%%04d.png or one.png (headless: default <avatar>.mp4)")
    add("--camera", default="static", metavar="static|orbit|FILE", help="camera path (default: static)")
    add("--audio", type=Path, metavar="FILE.wav", help="sound that plays with the source, or of out.mp4")
    add("--stats", type=Path, metavar="FILE", help="write times per stage to this JSON file")


def _add_page(add: Add) -> None:
    """In a browser."""
    add(
        "--serve",
        nargs="?",
        const=SERVE,
        metavar="HOST:PORT",
        help=f"no window: a page for browsers, with pictures of at most --size (default: {SERVE})",
    )
    add("--token", metavar="X", help="what --serve asks for (default: made up where others can reach it)")


def _size(text: str) -> tuple[int, int]:
    from cap4d.player.offline import parse_size

    try:
        return parse_size(text)
    except ArgumentError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("size: ")) from error


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number, 1 or more, got {text}")
    return int(text)


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= 1000:
        raise argparse.ArgumentTypeError(f"expected frames per second, above 0 and up to 1000, got {text}")
    return value
