"""The `.cap4d` file: one avatar, all that a player needs and nothing else. FORMAT.md specifies it."""

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.inspect import describe
from cap4d.bundle.reader import read_bundle, read_manifest
from cap4d.bundle.writer import write_bundle

__all__ = ["Bundle", "describe", "read_bundle", "read_manifest", "write_bundle"]
