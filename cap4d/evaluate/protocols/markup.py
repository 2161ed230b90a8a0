"""The little Markdown that the tables are written in, as HTML: headings, bullets, tables, paragraphs."""

from __future__ import annotations

import html
from collections.abc import Iterable

STYLE = """
body { font: 14px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; padding: 0 1rem }
body { max-width: 110rem }
table { border-collapse: collapse; margin: 1rem 0 }
td, th { padding: .3rem .8rem; border-bottom: 1px solid #e6e6e6; text-align: right; white-space: nowrap }
td:nth-child(-n+2), th:nth-child(-n+2) { text-align: left }
.strip { display: flex; flex-wrap: wrap; gap: .5rem }
figure { margin: 0; width: 256px } img { width: 100%; border-radius: 4px }
figcaption { color: #666; font-size: 12px }
"""


def as_html(lines: Iterable[str]) -> str:
    """The page up to and without `</body>`: what stands there is up to the caller."""
    parts = [f"<!doctype html><html lang='en'><head><meta charset='utf-8'><style>{STYLE}</style>"]
    parts.append("<title>Self-reenactment</title></head><body>")
    rows: list[str] = []
    for line in [*lines, ""]:
        if line.startswith("|"):
            rows.append(line)
            continue
        if rows:
            parts.append(_table(rows))
            rows = []
        if line:
            parts.append(_block(line))
    return "\n".join(parts) + "\n"


def _block(line: str) -> str:
    level = len(line) - len(line.lstrip("#"))
    if level:
        return f"<h{level}>{html.escape(line[level:].strip())}</h{level}>"
    if line.startswith("- "):
        return f"<div>{html.escape(line[2:])}</div>"
    return f"<p>{html.escape(line)}</p>"


def _table(rows: list[str]) -> str:
    lines = [_row(row, "th" if i == 0 else "td") for i, row in enumerate(rows) if i != 1]
    return "<table>" + "\n".join(lines) + "</table>"


def _row(line: str, tag: str) -> str:
    cells = (html.escape(cell.strip()) for cell in line.strip().strip("|").split("|"))
    return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
