"""How the numbers are made, in words, so that anyone can make them again. It closes every report."""

from __future__ import annotations

STEPS = (
    "Views are fixed: view 0 of the scene's cameras, the avatar's own camera at 512 x 512.",
    "Reading files, building scenes, the first frame and writing pictures are outside every time.",
    "All calls of a table take turns, five runs of one call each, in another order every round, so that "
    "whatever else the machine does hits all alike. The first run of a turn warms up and does not count. "
    "Times are wall clock, median and 95th percentile over all runs (for frames the 99th too); Python's "
    "garbage collector rests meanwhile. Where other packages take part there is a pause before each turn, "
    "for their threads spin on.",
    "Ceilings are the best of many goes in the same run. A floor is the counted work of a scene at these "
    "ceilings, stage after stage. Targets in milliseconds were set at the anchors' ceilings; they are "
    "scaled by the ratio of the floors.",
    "Errors of splatting are against a float64 renderer without shortcuts, on black, in steps of 1/255; "
    "PSNR at peak 1.",
    "Forward + backward is the picture and all gradients (means, quats, scales, opacities, sh, means2d) "
    "for a fixed random gradient of the colours; the optimiser step has its own table.",
    "Memory of a call is what a fresh process holds at its peak during it, less what it held before; "
    "memory of frames is the peak of a process that loads the avatar and plays.",
    "A frame is the time from one picture to the next in the loop that renders videos: clip, head rig, "
    "deformer, binding, sorting, splatting, 8 bits on white. The idle clip plays, the camera stands "
    "still. Pipelined, the next face is worked out while a frame is drawn, on half of the threads each. "
    "Tiers take turns in blocks of 25 frames, of which the first 2 do not count.",
    "A frame's PSNR is of its 8-bit pixels against the most exact tier's Gaussians drawn in float64, the "
    "squared error pooled over the compared frames; the rounding to 8 bits alone leaves 59 dB.",
    "Other instruction sets run in processes of their own (CAP4D_ISA).",
)


def markdown(command: str) -> list[str]:
    """The section of the report.

    Args:
        command: That made it.
    """
    steps = (f"{i}. {step}" for i, step in enumerate(STEPS, 1))
    return ["## Protocol", "", *steps, "", "To repeat it:", "", f"    {command}", ""]
