"""docs/recipes.md says what the presets say, and leaves none of their constants out."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest

pytest.importorskip("torch")

from recipe_table import PAGE, ROWS, page_with, recipe_table

from cap4d.avatar.presets import preset_named

NO_CONSTANT = {"name", "recipe", "checkpoint_every"}
OTHER = {
    "kind": "none",
    "image_range": "compat",
    "split_offset": "local",
    "measures": "quick",
    "bounds": "closed",
    "corrections": "none",
    "most": 5,
}


def test_the_page_is_that_of_the_presets():
    assert PAGE.read_text() == page_with(recipe_table()), "python tests/recipe_table.py writes it anew"


def changed(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The same settings once for every constant in them, with another value for that one."""
    for field in fields(settings):
        value, name = getattr(settings, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            for inner, other in changed(value, f"{name}."):
                yield inner, replace(settings, **{field.name: other})
        elif name not in NO_CONSTANT:
            yield name, replace(settings, **{field.name: another(field.name, value)})


def another(name: str, value: Any) -> Any:
    if name in OTHER:
        return OTHER[name]
    if isinstance(value, bool):
        return not value
    return tuple(another(name, x) for x in value) if isinstance(value, tuple) else 2 * value + 1


def test_no_constant_is_left_out():
    preset = preset_named("low", "released")
    preset = replace(preset, densify=replace(preset.densify, prune_radius=20.0))
    before = [cell(preset) for cell in ROWS.values()]
    unsaid = [name for name, other in changed(preset) if [cell(other) for cell in ROWS.values()] == before]
    assert unsaid == ["densify.prune_least"]  # 0 in every preset, chosen by --prune contribution
