"""A capture's folder that appears whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cap4d.errors import ArgumentError


def check_new_folder(output: Path) -> None:
    """Raises ArgumentError unless a capture can go there: the parent exists; it is empty or not there."""
    if output.exists() and not (output.is_dir() and not any(output.iterdir())):
        raise ArgumentError(f"output: {output} exists already; choose another folder or remove it")
    if not output.parent.is_dir():
        raise ArgumentError(f"output: the folder of {output} does not exist")


@contextmanager
def new_folder(output: Path) -> Iterator[Path]:
    """A temporary folder beside `output` that takes its place when all went well, and is gone otherwise.

    Raises:
        ArgumentError: No folder can be made there.
    """
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=output.parent))
    except OSError as error:
        raise ArgumentError(f"output: {output} cannot be written: {error.strerror}") from error
    try:
        yield folder
        folder.chmod(0o755)
        folder.replace(output)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
