"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cap4d.errors import ArgumentError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, for the body to write; it becomes `path` when the body ends well.

    When the body raises (Ctrl-C too), the temporary file goes and `path` is as it was.

    Raises:
        ArgumentError: `path` is a folder, its folder does not exist, or no file can be made there.
    """
    if path.is_dir():
        raise ArgumentError(f"{path}: is a folder, not a file to write")
    if not path.parent.is_dir():
        raise ArgumentError(f"{path}: its folder does not exist")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.touch()
    except OSError as error:
        raise ArgumentError(f"{path}: cannot be written: {error.strerror}") from error
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
