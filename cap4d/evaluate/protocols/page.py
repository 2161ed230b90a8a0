"""The pictures of a protocol side by side: page.html with the tables, and page.png."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np

from cap4d.atomic import replacing
from cap4d.avatar.views import shrink
from cap4d.capture.capture import Capture
from cap4d.capture.image import write_image
from cap4d.evaluate.protocols.cell import Result
from cap4d.evaluate.protocols.layout import METHODS, counted, of_row, rows_of
from cap4d.evaluate.protocols.markup import as_html
from cap4d.evaluate.protocols.titled_sheet import draw_sheet

VIEWS = 3  # per identity
TRUTH = "truth"


@dataclass(frozen=True)
class Strip:
    """One view of one person in all columns: title -> picture file, in the protocol's folder."""

    title: str
    pictures: dict[str, Path]


def write_page(output: Path, results: Sequence[Result]) -> None:
    """Of self-reenactment, some views of every person: truth, and every row of the table."""
    strips = [s for identity in _identities(results) for s in strips_of(output, results, identity)]
    draw_page(output, [TRUTH, *(_title(row) for row in rows_of(results))], strips)


def draw_page(output: Path, titles: Sequence[str], strips: Sequence[Strip]) -> None:
    """Writes page.html and page.png into a protocol's folder, beside table.md, which is its text.

    Args:
        titles: Of the pictures' columns, in order; a strip need not have all.
    """
    lines = (output / "table.md").read_text(encoding="utf-8").splitlines()
    body = as_html(lines) + _pictures(output, titles, strips)
    with replacing(output / "page.html") as temporary:
        temporary.write_text(body, encoding="utf-8")
    draw_sheet(output / "page.png", titles, [(s.title, s.pictures) for s in strips])


def strips_of(output: Path, results: Sequence[Result], identity: str) -> list[Strip]:
    """Some views of a person, each with its truth, which is written into the folder."""
    own = [r for r in results if r.cell.identity == identity]
    cell = own[0].cell
    capture = Capture.load(cell.capture)
    strips = []
    for view in shown_views(capture, cell.views):
        file = output / "truth" / identity / f"{view[0]}_{view[1]:05d}.png"
        write_truth(capture, view, cell.size, file)
        pictures = {_title(row): r.picture(view) for row in rows_of(own) for r in of_row(own, row)}
        strips.append(Strip(f"{identity}, {view[0]}, frame {view[1]}", {TRUTH: file, **pictures}))
    return strips


def shown_views(capture: Capture, views: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """One view of each of `VIEWS` cameras, side to side: that with the strongest expression."""
    cameras = list(dict.fromkeys(camera for camera, _ in views))
    picked = np.unique(np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().astype(int))
    strength = np.linalg.norm(capture.expr, axis=1)
    shown: list[tuple[str, int]] = []
    for camera in (cameras[i] for i in picked):
        taken = {frame for _, frame in shown}
        own = [v for v in views if v[0] == camera]
        fresh = [v for v in own if v[1] not in taken] or own
        shown.append(max(fresh, key=lambda v: strength[v[1]]))
    return shown


def write_truth(capture: Capture, view: tuple[str, int], size: int, file: Path) -> None:
    """The image of a view as the metrics see it: on white, averaged down."""
    own = next(v for v in capture.views if (v.camera, v.frame) == tuple(view))
    image = capture.image(own)
    scale = min(1.0, size / max(image.shape[:2]))
    height, width = (round(side * scale) for side in image.shape[:2])
    file.parent.mkdir(parents=True, exist_ok=True)
    write_image(file, shrink(image, width, height).numpy())


def _title(row: tuple[int, str]) -> str:
    count, method = row
    return f"{METHODS[method]}, {counted(count)}"


def _identities(results: Iterable[Result]) -> list[str]:
    return list(dict.fromkeys(r.cell.identity for r in results))


def _pictures(output: Path, titles: Sequence[str], strips: Sequence[Strip]) -> str:
    parts = ["<h2>Side by side</h2>"]
    for strip in strips:
        parts.append(f"<h3>{html.escape(strip.title)}</h3><div class='strip'>")
        for title in titles:
            if title in strip.pictures:
                source = quote(strip.pictures[title].relative_to(output).as_posix())
                text = html.escape(title)
                parts.append(
                    f"<figure><img src='{source}' alt='{text}'><figcaption>{text}</figcaption></figure>"
                )
        parts.append("</div>")
    return "\n".join(parts) + "\n</body></html>\n"
