"""`cap4d export`: an avatar's frames as files of plain Gaussians."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cap4d.commands.command import add_avatar, command

EXPORT = """Each file is one moment, for tools that know no rig. Without a source it is the face at rest; of a
source it is one --frame, or else all of it, in numbered files. The head stands still, its face moves.

  ply    as of 3D Gaussian splatting; float32, y down
  splat  32 bytes a Gaussian, without what depends on the view; y down
  spz    a tenth of a ply, in 8 bits (positions in 24); y up
  glb    glTF with KHR_gaussian_splatting; float32, y up"""


def add(commands) -> None:
    parser = command(
        commands,
        "export",
        run_export,
        "write an avatar's frames as plain Gaussians for other tools",
        "cap4d export me.cap4d --format ply --drive fit.npz --frame 12 -o me.ply",
        more=EXPORT,
    )
    add_avatar(parser)
    parser.add_argument(
        "--format", required=True, choices=("ply", "splat", "spz", "glb"), help="kind of file, see above"
    )
    parser.add_argument("--drive", metavar="SRC", help="fit.npz, vertices .npy or Live Link Face .csv")
    parser.add_argument(
        "--template", type=Path, metavar="FILE", help="neutral vertices for an .npy (.npy, .npz or .obj)"
    )
    parser.add_argument(
        "--frame", type=int, metavar="N", help="one frame, from 0, of the source or the avatar's idle clip"
    )
    parser.add_argument(
        "--frames",
        metavar="RANGE",
        help="all, FIRST:END or FIRST:END:STEP: frames of the source or the avatar's idle clip (default of a "
        "source: all)",
    )
    parser.add_argument(
        "--deformer",
        default="auto",
        choices=("auto", "full", "fp16", "int8", "linear", "off"),
        help="how the deformation network is evaluated; auto: the most exact (default: auto)",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="file, or folder for more than one frame",
    )


def run_export(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the viewer
    from cap4d.export.frames import export_file

    export_file(
        arguments.avatar,
        arguments.output,
        format=arguments.format,
        drive=arguments.drive,
        template=arguments.template,
        frame=arguments.frame,
        frames=arguments.frames,
        deformer=arguments.deformer,
    )
