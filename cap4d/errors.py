"""The two ways a request can fail. Raised where the cause is known; the CLI makes exit codes of them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

EXTRAS = {
    **dict.fromkeys(("cv2", "mediapipe"), "pip install 'cap4d[track]'"),
    "websockets": "pip install 'cap4d[live]'",
    **dict.fromkeys(("onnx", "onnxscript"), "pip install 'cap4d[fit]'"),
    **dict.fromkeys(
        ("torch", "OpenImageIO", "trimesh", "scipy"),
        "pip install 'cap4d[fit]' (or 'cap4d[track]', to track)",
    ),
}
"""How to get the packages that playing does not need."""


class Cap4dError(Exception):
    """Anything cap4d refuses on purpose; its text is one line meant for the user."""


class DataError(Cap4dError):
    """A file or packet from outside is not what it should be (exit code 1).

    Args:
        source: The file (or `file:entry`) or stream the data came from.
        field: What in it is wrong.
        expected: What was expected there.
        found: What was found.
    """

    def __init__(self, source: str | Path, field: str, *, expected: str, found: object) -> None:
        self.source, self.field, self.expected, self.found = str(source), field, expected, str(found)
        line = f"{self.source}: {field}: expected {expected}, found {self.found}"
        super().__init__(" ".join(line.split()))


class ArgumentError(Cap4dError):
    """An argument makes no sense or names something that is not there (exit code 2)."""


def exit_code(program: str, run: Callable[[], int | None]) -> int:
    """Runs a program; a failure that is no bug becomes one line on stderr and a code.

    1: bad data, or what the system refused (a read-only folder, a full disk); 2: a bad argument, or a package
    that is not installed; 130: interrupted.
    """
    try:
        return run() or 0
    except ArgumentError as error:
        line, code = str(error), 2
    except Cap4dError as error:
        line, code = str(error), 1
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:  # one of our own, or one that every installation has: a bug
            raise
        line, code = f"the package {error.name} is not installed: this needs {EXTRAS[error.name]}", 2
    except OSError as error:
        line, code = _os_line(error), 1
    except KeyboardInterrupt:
        line, code = "interrupted", 130
    print(f"{program}: {line}", file=sys.stderr)
    return code


def _os_line(error: OSError) -> str:
    """`out/a.png: Permission denied`"""
    reason = error.strerror or str(error) or type(error).__name__
    parts = [reason] if error.filename is None else [str(error.filename), reason]
    return " ".join(": ".join(parts).split())
