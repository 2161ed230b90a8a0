"""The files opened lately, remembered in the user's configuration folder."""

from __future__ import annotations

import json
import logging
import os
import sys
from pathlib import Path

from cap4d.atomic import replacing
from cap4d.errors import ArgumentError

log = logging.getLogger(__name__)

KEPT = 10
MAX_BYTES = 64 << 10
MAX_PATH = 4096  # characters


class RecentFiles:
    """Newest first. A file of it that is missing, broken or hostile is an empty list; one that cannot be
    written costs the memory of it, nothing else.

    Args:
        path: The JSON file: a list of strings.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: list[Path] = _read(path)

    def add(self, file: Path) -> None:
        """Puts `file` on top and writes the list."""
        file = Path(os.path.abspath(file))
        self.files = [file, *(f for f in self.files if f != file)][:KEPT]
        self._write()

    def forget(self, file: Path) -> None:
        """Takes `file` out, e.g. because it is gone."""
        self.files = [f for f in self.files if f != file]
        self._write()

    def clear(self) -> None:
        """Forgets all."""
        self.files = []
        self._write()

    def _write(self) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.path) as temporary:
                temporary.write_text(json.dumps([str(f) for f in self.files], indent=1) + "\n")
        except (ArgumentError, OSError, UnicodeError) as error:  # a read-only home, a name that is no text
            log.warning("recent files are not kept: %s", error)


def config_folder() -> Path:
    """Where the user's settings of cap4d live."""
    if sys.platform == "win32":
        return Path(os.environ.get("APPDATA") or Path.home() / "AppData/Roaming") / "cap4d"
    if sys.platform == "darwin":
        return Path.home() / "Library/Application Support/cap4d"
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "cap4d"


def _read(path: Path) -> list[Path]:
    try:
        if not path.is_file():  # a pipe would never end
            return []
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        names = json.loads(data) if len(data) <= MAX_BYTES else None
    except (OSError, ValueError, RecursionError):
        return []
    if not isinstance(names, list):
        return []
    sound = [n for n in names if isinstance(n, str) and 0 < len(n) <= MAX_PATH and n.isprintable()]
    return [Path(name) for name in dict.fromkeys(sound)][:KEPT]
