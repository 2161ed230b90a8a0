"""The two ways a request can fail. Raised where the cause is known; the CLI makes exit codes of them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path


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
    """Runs a program; a refusal becomes one line on stderr and a code: 1 bad data, 2 a bad argument."""
    try:
        return run() or 0
    except ArgumentError as error:
        line, code = str(error), 2
    except Cap4dError as error:
        line, code = str(error), 1
    except KeyboardInterrupt:
        line, code = "interrupted", 130
    print(f"{program}: {line}", file=sys.stderr)
    return code
