"""The little Markdown that the tables are written in, as HTML: headings, bullets, tables, paragraphs."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from itertools import groupby

STYLE = """
body { font: 14px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; padding: 0 1rem }
body { max-width: 110rem }
p, ul { max-width: 60rem } ul { padding-left: 1.2rem }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto }
td, th { padding: .3rem .8rem; border-bottom: 1px solid #e6e6e6; text-align: left; white-space: nowrap }
.number { text-align: right; font-variant-numeric: tabular-nums }
.strip { display: flex; flex-wrap: wrap; gap: .5rem }
figure { margin: 0; width: 256px } img { width: 100%; border-radius: 4px }
figcaption { color: #666; font-size: 12px }
"""


def as_html(lines: Sequence[str]) -> str:
    """The page without its end, which is up to the caller; titled by the first line."""
    title = html.escape(lines[0].lstrip("# ")) if lines else ""
    head = f"<!doctype html><html lang='en'><head><meta charset='utf-8'><style>{STYLE}</style>"
    parts = [f"{head}\n<title>{title}</title></head><body>"]
    for kind, block in groupby(lines, key=_kind):
        parts += BLOCKS[kind](list(block))
    return "\n".join(parts) + "\n"


def _kind(line: str) -> str:
    """A key of BLOCKS; what is of one kind and stands together is one block."""
    starts = {"#": "heading", "|": "table", "- ": "bullets"}
    found = next((kind for start, kind in starts.items() if line.startswith(start)), "paragraph")
    return found if line else "nothing"


def _headings(lines: list[str]) -> Iterable[str]:
    for line in lines:
        text = line.lstrip("#")
        level = len(line) - len(text)
        yield f"<h{level}>{html.escape(text.strip())}</h{level}>"


def _bullets(lines: list[str]) -> list[str]:
    items = "\n".join(f"<li>{html.escape(line[2:])}</li>" for line in lines)
    return [f"<ul>{items}</ul>"]


def _table(lines: list[str]) -> list[str]:
    numbers = [cell.endswith(":") for cell in _cells(lines[1])]
    rows = [_row(line, "th" if i == 0 else "td", numbers) for i, line in enumerate(lines) if i != 1]
    return ["<table>" + "\n".join(rows) + "</table>"]


def _row(line: str, tag: str, numbers: Sequence[bool]) -> str:
    kinds = (" class='number'" if number else "" for number in numbers)
    cells = (
        f"<{tag}{kind}>{html.escape(cell)}</{tag}>" for kind, cell in zip(kinds, _cells(line), strict=True)
    )
    return "<tr>" + "".join(cells) + "</tr>"


def _cells(line: str) -> list[str]:
    inner = line.strip().removeprefix("|").removesuffix("|")
    return [cell.replace("\\|", "|").strip() for cell in re.split(r"(?<!\\)\|", inner)]


BLOCKS = {
    "heading": _headings,
    "bullets": _bullets,
    "table": _table,
    "paragraph": lambda lines: [f"<p>{html.escape(' '.join(lines))}</p>"],
    "nothing": lambda lines: [],
}
