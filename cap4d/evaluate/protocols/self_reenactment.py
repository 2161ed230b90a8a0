"""Self-reenactment: avatars from few and from many images of a person, driven by the person's own expressions
and judged where no camera of the fit looked (fact 74).

The paper: 9 NeRSemble sequences, 16 cameras, 4 of them held out with 100 frames each; 1, 10 and 100
references; 512 px. A held-out camera's frames may have been seen by other cameras, there as here.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.atomic import replacing
from cap4d.avatar.presets import Preset
from cap4d.avatar.references import choose_held_out, choose_references
from cap4d.avatar.views import check_rig
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError
from cap4d.evaluate.evaluate import SIZES
from cap4d.evaluate.protocols.cell import Cell, Judge, Result, run_cell
from cap4d.evaluate.protocols.cells import Failure, check_whole, run_cells
from cap4d.evaluate.protocols.layout import (
    METHODS,
    gain_table,
    gains_of,
    identity_table,
    mean_table,
    metrics_of,
)
from cap4d.evaluate.protocols.page import write_page
from cap4d.rig.head import HeadRig
from cap4d.rig.store import load_rig

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Protocol:
    """How the table is made.

    Args:
        references: Counts.
        methods: `none` and what is left out (`METHODS`).
        preset: Of every fit.
        hold_out: So many cameras, or their names.
        frames: So many of each held-out camera, evenly over its frames, every camera's others; None: all.
        size: Pixels of the larger side that views are judged at; None: the preset's.
        generated: A folder with captures made from the references, as `<person>/<count>`; None: the fits have
            their references alone.
        seed, reference_seed: Of the fits, and of the choice of references.
        lpips_weights: For fits with an LPIPS term (see `fit`).
    """

    preset: Preset
    references: tuple[int, ...] = (1, 10, 100)
    methods: tuple[str, ...] = ("none",)
    hold_out: int | tuple[str, ...] = 4
    frames: int | None = None
    size: int | None = None
    generated: Path | None = None
    seed: int = 0
    reference_seed: int = 0
    lpips_weights: Path | None = None


def self_reenactment(
    captures: Sequence[Path],
    rig: Path,
    output: Path,
    protocol: Protocol,
    *,
    judge: Judge,
    judged_by: str,
) -> list[Result]:
    """Makes the table; what an earlier call for the same folder finished is kept.

    Args:
        captures: One per person.
        output: Folder, made if need be, for report.json, table.md, page.html, page.png and the cells.
        judge, judged_by: See `run_cell`.
    Raises:
        ArgumentError: Something is asked for that the captures cannot give.
        DataError: A capture is malformed or of another rig, or a cell failed: the rest of the table is there.
    """
    cells = plan(captures, rig, protocol)
    output.mkdir(parents=True, exist_ok=True)

    def note(results: list[Result], failures: list[Failure]) -> None:
        write_tables(output, protocol, results, failures)

    folder = output / "cells"
    jobs = [(cell.name, partial(run_cell, cell, rig, folder, judge, judged_by)) for cell in cells]
    results, failures = run_cells(jobs, after=note)
    if results:
        write_page(output, results)
    check_whole(output / "report.json", len(cells), failures)
    return results


def plan(captures: Sequence[Path], rig: Path, protocol: Protocol) -> list[Cell]:
    """All cells, person after person: a table with one person whole is worth more than three with holes."""
    unknown = [m for m in protocol.methods if m not in METHODS]
    if unknown or not protocol.methods:
        raise ArgumentError(
            f"ablate: expected some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}"
        )
    if "mmdm" in protocol.methods and protocol.generated is None:
        raise ArgumentError(
            "ablate: expected generated captures (--generated) for mmdm to leave out, got none"
        )
    if not protocol.references or min(protocol.references) < 1:
        raise ArgumentError(f"references: expected counts from 1 on, got {list(protocol.references)}")
    _check_numbers(protocol)
    head = load_rig(rig)
    names = _names(captures)
    return [
        cell for path, name in zip(captures, names, strict=True) for cell in _of(path, name, head, protocol)
    ]


def _check_numbers(protocol: Protocol) -> None:
    """Raises ArgumentError for what would only be found out when cells are fitted and judged."""
    if protocol.frames is not None and protocol.frames < 1:
        raise ArgumentError(f"frames: expected at least 1, got {protocol.frames}")
    if protocol.size is not None and not SIZES[0] <= protocol.size <= SIZES[1]:
        raise ArgumentError(f"size: expected {SIZES[0]} to {SIZES[1]} px, got {protocol.size}")
    for name in ("seed", "reference_seed"):
        if not 0 <= getattr(protocol, name) < 2**63:
            raise ArgumentError(f"{name}: expected 0 to 2^63 - 1, got {getattr(protocol, name)}")


def _of(path: Path, name: str, rig: HeadRig, protocol: Protocol) -> list[Cell]:
    capture = Capture.load(path)
    check_rig(capture, rig)
    hold_out = protocol.hold_out
    if isinstance(hold_out, int):
        hold_out = choose_held_out(capture, hold_out)
    views = judged_views(capture, hold_out, protocol.frames)
    most = max(protocol.references)
    order = choose_references(capture, rig, most, hold_out=hold_out, seed=protocol.reference_seed)
    return [
        Cell(
            identity=name,
            capture=path,
            generated=_generated(protocol, name, count),
            references=tuple(order[:count]),
            hold_out=hold_out,
            ablate=None if method == "none" else method,
            preset=protocol.preset,
            seed=protocol.seed,
            views=views,
            size=protocol.preset.image_size if protocol.size is None else protocol.size,
            lpips_weights=protocol.lpips_weights,
        )
        for count in protocol.references
        for method in protocol.methods
    ]


def judged_views(capture: Capture, cameras: Sequence[str], frames: int | None) -> tuple[tuple[str, int], ...]:
    """(camera, frame) of the held-out views: `frames` of each camera, evenly over those it has.

    Cameras take turns with the frames, so that together they show as many faces as they can.
    """
    chosen: list[tuple[str, int]] = []
    for i, camera in enumerate(cameras):
        own = sorted(v.frame for v in capture.views if v.camera == camera)
        if not own:
            raise ArgumentError(f"hold_out: expected cameras with images in {capture.path}, got {camera!r}")
        if frames is None or frames >= len(own):
            picked = range(len(own))
        else:
            places = (np.arange(frames) + (i + 0.5) / len(cameras)) / frames
            picked = np.floor(places * len(own)).astype(int)
        chosen += [(camera, own[k]) for k in picked]
    if not chosen:
        raise ArgumentError("hold_out: expected at least one camera to judge by, got none")
    return tuple(chosen)


def write_tables(
    output: Path, protocol: Protocol, results: Sequence[Result], failures: Sequence[Failure]
) -> None:
    """report.json and table.md, of what is done so far."""
    with replacing(output / "report.json") as temporary:
        text = json.dumps(document(protocol, results, failures), indent=1, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    with replacing(output / "table.md") as temporary:
        temporary.write_text("\n".join(markdown(protocol, results, failures)), encoding="utf-8")


def document(protocol: Protocol, results: Sequence[Result], failures: Sequence[Failure]) -> dict[str, Any]:
    """All numbers: every cell's means and values per view, and the paired gains."""
    return {
        "protocol": "self-reenactment",
        "settings": _settings(protocol),
        "cells": [_cell_document(r) for r in results],
        "failed": [{"cell": f.name, "reason": f.reason} for f in failures],
        "gains": {t: {g.metric: g.document() for g in gains} for t, gains in gains_of(results).items()},
        "not_measured": {name: needs for r in results for name, needs in r.missing.items()},
    }


def markdown(protocol: Protocol, results: Sequence[Result], failures: Sequence[Failure]) -> list[str]:
    """The tables, and in words how they were made."""
    lines = ["# Self-reenactment", "", *_how(protocol, results), ""]
    lines += [f"- failed: {f.name}: {f.reason}" for f in failures] + [""] * bool(failures)
    if not results:
        return lines
    lines += ["## Mean over identities", "", *mean_table(results)]
    lines += ["± is the standard error over identities.", ""]
    lines += ["## Is a row better?", "", *gain_table(results)]
    lines += ["Paired, on the same views: mean over identities ± standard error (identities that gain).", ""]
    for identity in dict.fromkeys(r.cell.identity for r in results):
        lines += [f"## {identity}", "", *identity_table(results, identity)]
    absent = {name: needs for r in results for name, needs in r.missing.items()}
    lines += [f"- {name}: not measured: needs {needs}" for name, needs in absent.items()]
    return [*lines, ""]


def _how(protocol: Protocol, results: Sequence[Result]) -> list[str]:
    p = protocol.preset
    what = f"recipe {p.recipe}, preset {p.name}, {p.iterations} steps at {p.image_size} px"
    lines = [f"Every fit: {what}, seed {protocol.seed}."]
    if protocol.generated is None:
        lines.append("Fits have their references alone: there are no generated views in any row.")
    if results:
        cell = results[0].cell
        views, cameras = len(cell.views), ", ".join(cell.hold_out)
        lines.append(f"Judged on {views} views of held-out cameras ({cameras}) per identity, {cell.size} px.")
    lines.append("The paper: 9 identities, 4 held-out cameras x 100 frames, 512 px.")
    return [f"- {line}" for line in lines]


def _settings(protocol: Protocol) -> dict[str, Any]:
    plain = {
        k: getattr(protocol, k)
        for k in ("references", "methods", "hold_out", "frames", "seed", "reference_seed")
    }
    p = protocol.preset
    return plain | {
        "recipe": p.recipe,
        "preset": p.name,
        "iterations": p.iterations,
        "image_size": p.image_size,
        "all": repr(p),
    }


def _cell_document(r: Result) -> dict[str, Any]:
    c = r.cell
    return {
        "identity": c.identity,
        "method": c.method,
        "references": [list(pair) for pair in c.references],
        "hold_out": list(c.hold_out),
        "views": [list(v) for v in c.views],
        "size": c.size,
        "avatar": f"cells/{r.folder.name}/avatar.cap4d",
        "mean": {m: r.mean(m) for m in metrics_of([r])},
        "values": {m: [float(x) if np.isfinite(x) else None for x in v] for m, v in r.values.items()},
        "fit": r.fit,
    }


def _names(captures: Sequence[Path]) -> list[str]:
    """What the tables call the persons: their folders' names, which must differ."""
    names = [path.resolve().name for path in captures]
    if not names or len(set(names)) != len(names):
        raise ArgumentError(
            f"captures: expected folders of different names, got {', '.join(names) or 'none'}"
        )
    return names


def _generated(protocol: Protocol, name: str, count: int) -> tuple[Path, ...]:
    if protocol.generated is None:
        return ()
    path = protocol.generated / name / str(count)
    if not path.is_dir():
        raise ArgumentError(f"generated: expected {path}, a capture made from {count} references of {name}")
    return (path,)
