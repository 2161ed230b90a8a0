"""`cap4d bench`: speed against error."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cap4d.commands.command import command


def add(commands) -> None:
    parser = command(
        commands,
        "bench",
        run_bench,
        "measure speed against error, and write a report",
        "cap4d bench --report bench --avatar me.cap4d",
        more="Splatter, fitting step, deformer and whole frames, beside the machine's ceilings and peers.",
    )
    parser.add_argument(
        "sections",
        nargs="*",
        metavar="SECTION",
        help="some of ceilings splat fit deformer frame optimize peers (default: all)",
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
        help="the same, with commas",
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
    named = " ".join(arguments.sections)
    if named and arguments.only is not None:
        raise ArgumentError("sections: expected them by name or in --only, got both")
    wanted = named if named else arguments.only
    settings = Settings(
        sections=SECTIONS if wanted is None else parse_sections(wanted),
        threads=arguments.threads,
        quick=arguments.quick,
        avatars=tuple(arguments.avatar),
        scenes=arguments.scenes,
    )
    bench(arguments.report, settings)
