"""Files appear whole or not at all; a place where no file can be is the user's mistake, said in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from cap4d.atomic import replacing
from cap4d.errors import ArgumentError


def test_a_file_appears_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old" and temporary.parent == tmp_path
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_what_was_there(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), replacing(path) as temporary:
        temporary.write_text("ne")
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("folder", "is a folder"),
        ("", "is a folder"),
        ("none/a.txt", "its folder does not exist"),
        ("file/a.txt", "its folder does not exist"),
        ("x" * 250, "cannot be written: File name too long"),
    ],
)
def test_impossible_targets_are_argument_errors(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(ArgumentError, match=reason), replacing(tmp_path / name):
        pytest.fail("nothing is to be written")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
