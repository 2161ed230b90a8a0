"""Operations and bytes of the splatter beside the time they took: where it stands under the machine's
roofs.
"""

from __future__ import annotations

from typing import Any

from cap4d.evaluate.bench.ceilings import Ceilings
from cap4d.evaluate.bench.floor import Stage, backward_floor, forward_floor, total_ms
from cap4d.evaluate.bench.passes import lanes
from cap4d.evaluate.bench.work import Work

FLOOR_OF = {"project": ("project",), "sort": ("sort",), "tiles": ("bin",), "rasterize": ("blend", "write")}
"""Stages that the splatter times -> those of the floor that they do."""


def roofline(
    work: Work, ceilings: Ceilings, times: dict[str, Any], measured: dict[str, float]
) -> list[dict[str, Any]]:
    """Operations, bytes, floor and milliseconds of `forward`, stage by stage, and of `forward_backward`.

    Args:
        measured: See `Playing.stage_ms`.
    """
    play = forward_floor(work, ceilings, lanes=lanes(), half_sh=True)
    train = forward_floor(work, ceilings, lanes=lanes()) + backward_floor(work, ceilings, lanes=lanes())
    found = [
        {
            "name": name,
            "flops": sum(stage.flops for stage in parts),
            "bytes": sum(stage.bytes for stage in parts),
            "floor_ms": round(total_ms(parts), 3),
            "ms": times[name]["median_ms"],
            "stages": [stage.report() for stage in parts],
        }
        for name, parts in (("forward", play), ("forward_backward", train))
    ]
    found[0]["measured"] = [_measured(name, ms, play) for name, ms in measured.items()]
    return found


def _measured(name: str, ms: float, floor: list[Stage]) -> dict[str, Any]:
    parts = [stage for stage in floor if stage.name in FLOOR_OF[name]]
    sums = {key: sum(getattr(stage, key) for stage in parts) for key in ("flops", "bytes")}
    return {"name": name, "ms": ms, "floor_ms": round(total_ms(parts), 4), **sums}
