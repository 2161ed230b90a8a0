"""The expressions of a rig as a person looks for them: in groups of the face, by readable names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GROUPS = {
    "Brows": ("brow",),
    "Eyes": ("eye", "blink", "gaze"),
    "Cheeks and nose": ("cheek", "nose"),
    "Jaw": ("jaw",),
    "Mouth": ("mouth", "lip"),
    "Tongue": ("tongue",),
}
"""Group -> the words that a name of it begins with, or holds."""
OTHER = "Expressions"
SIDES = {"L": "left", "R": "right", "Left": "left", "Right": "right"}


@dataclass(frozen=True)
class Expression:
    """One expression of a rig.

    Args:
        index: Where it stands in the vector.
        name: As the rig calls it.
        label: For people: `Mouth smile left`.
        group: One of `GROUPS`, or `OTHER`.
        low, high: Its useful values.
    """

    index: int
    name: str
    label: str
    group: str
    low: float
    high: float


def listed(names: Sequence[str], ranges: np.ndarray) -> list[Expression]:
    """All expressions of a rig, group after group.

    Args:
        names: In the order of the vector.
        ranges: float32[E, 2]; an empty or upside-down range becomes one of width 1.
    """
    order = [*GROUPS, OTHER]
    found = []
    for index, (name, (low, high)) in enumerate(zip(names, ranges, strict=True)):
        high = high if high > low else low + 1
        found.append(Expression(index, name, label(name), group_of(name), float(low), float(high)))
    return sorted(found, key=lambda e: (order.index(e.group), e.index))


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


def group_of(name: str) -> str:
    """The part of the face that a name speaks of."""
    lower = name.lower()
    for begins in (True, False):
        for group, words in GROUPS.items():
            if any(lower.startswith(w) if begins else w in lower for w in words):
                return group
    return OTHER


def label(name: str) -> str:
    """`mouthSmile_L` -> `Mouth smile left`; `expr07` -> `Expression 7`."""
    numbered = re.fullmatch(r"(?:expr|expression)_?(\d+)", name)
    if numbered:
        return f"Expression {int(numbered[1])}"
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)
    text = " ".join(SIDES.get(word, word.lower()) for word in words)
    return text[:1].upper() + text[1:] if text else name
