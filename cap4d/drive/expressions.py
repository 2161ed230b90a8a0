"""What an avatar's expressions are called, how far each goes, and which belong together."""

from __future__ import annotations

import numpy as np

from cap4d.bundle.bundle import Bundle

GROUPS = {
    "brows": ("brow",),
    "eyes": ("eye", "blink"),
    "jaw": ("jaw",),
    "mouth": ("mouth", "lip", "tongue"),
    "cheeks and nose": ("cheek", "nose"),
}
"""Group -> how its expressions' names begin, in small letters."""
OTHER = "shapes"  # those whose names say nothing, such as FLAME's principal components


def expression_names(bundle: Bundle) -> tuple[str, ...]:
    """E names, in the order of an expression vector: ARKit's or nearly (`eyeBlink_L`), or `expr00`."""
    return bundle.subject.expression_names


def expression_ranges(bundle: Bundle) -> np.ndarray:
    """float32[E, 2] the useful values of each; 0, which is neutral, lies within them."""
    return bundle.expression_range


def expression_groups(bundle: Bundle) -> dict[str, tuple[int, ...]]:
    """Group -> the numbers of its expressions, by name: left before right. Each is in one group; no empty
    ones.
    """
    names = expression_names(bundle)
    members: dict[str, list[int]] = {group: [] for group in (*GROUPS, OTHER)}
    for number, name in enumerate(names):
        members[_group(name)].append(number)
    return {
        group: tuple(sorted(numbers, key=lambda number: (names[number], number)))
        for group, numbers in members.items()
        if numbers
    }


def _group(name: str) -> str:
    small = name.lower()
    return next((group for group, starts in GROUPS.items() if small.startswith(starts)), OTHER)
