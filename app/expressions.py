"""The expressions of a rig as a person looks for them: in groups of the face, by readable names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from cap4d.bundle.bundle import Bundle
from cap4d.drive.expressions import expression_groups, expression_names, expression_ranges

SIDES = {"L": "left", "R": "right", "Left": "left", "Right": "right"}


@dataclass(frozen=True)
class Expression:
    """One expression of a rig.

    Args:
        index: Where it stands in the vector.
        name: As the rig calls it.
        label: For people: `Mouth smile left`.
        group: A part of the face: `Brows`; see `expression_groups`.
        low, high: Its useful values.
    """

    index: int
    name: str
    label: str
    group: str
    low: float
    high: float


def listed(bundle: Bundle) -> list[Expression]:
    """All expressions of an avatar, group after group; an empty range becomes one of width 1."""
    names, ranges = expression_names(bundle), expression_ranges(bundle)
    return [
        _expression(index, names[index], group, *(float(x) for x in ranges[index]))
        for group, members in expression_groups(bundle).items()
        for index in members
    ]


def matching(expressions: Sequence[Expression], words: str) -> list[Expression]:
    """Those whose name, label or group holds every word of `words`, whatever their case."""
    wanted = words.lower().split()
    return [e for e in expressions if all(w in f"{e.name} {e.label} {e.group}".lower() for w in wanted)]


def grouped(expressions: Sequence[Expression]) -> dict[str, list[Expression]]:
    """Group -> its expressions, in the order given."""
    groups: dict[str, list[Expression]] = {}
    for expression in expressions:
        groups.setdefault(expression.group, []).append(expression)
    return groups


def label(name: str) -> str:
    """`mouthSmile_L` -> `Mouth smile left`; `expr07` -> `Expression 7`."""
    numbered = re.fullmatch(r"(?:expr|expression)_?(\d+)", name)
    if numbered:
        return f"Expression {int(numbered[1])}"
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)
    text = " ".join(SIDES.get(word, word.lower()) for word in words)
    return text[:1].upper() + text[1:] if text else name


def _expression(index: int, name: str, group: str, low: float, high: float) -> Expression:
    return Expression(index, name, label(name), group.capitalize(), low, high if high > low else low + 1)
