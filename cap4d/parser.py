"""The command lines' parser: what it refuses is one line, as every other error is."""

from __future__ import annotations

import argparse
from typing import NoReturn


class OneLineParser(argparse.ArgumentParser):
    """Subparsers are of this class too."""

    def error(self, message: str) -> NoReturn:
        """Exits with code 2. The usage is left to `--help`: it would push the error out of sight."""
        line = " ".join(message.split())
        self.exit(2, f"{self.prog}: error: {line} ({self.prog} --help lists what there is)\n")
