"""The outer shell of a `.cap4d` file: a zip archive of stored entries, and nothing else a zip archive may be.

Own reader of a strict subset instead of `zipfile`: no compression (so no bombs), no encryption, no zip64, no
data descriptors, no comment, no overlap, and only names that the format knows (so no `..`). See FORMAT.md.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from cap4d.atomic import replacing
from cap4d.errors import DataError

ALIGNMENT = 64  # bytes; entry data starts at a multiple, so that tensors can be mapped
MAX_FILE_BYTES = 1 << 30
MAX_ENTRIES = 16

LOCAL = struct.Struct("<4s5H3I2H")
CENTRAL = struct.Struct("<4s6H3I5H2I")
END = struct.Struct("<4s4H2IH")
LOCAL_MAGIC, CENTRAL_MAGIC, END_MAGIC = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
PADDING_ID = 0xD935  # the extra field that zipalign uses for the same purpose
VERSION_NEEDED = 10
DOS_EPOCH = 0x0021  # 1980-01-01: a fixed date keeps files reproducible
NAME_FLAGS = (0, 0x800)  # plain or UTF-8 names; every other flag changes what the bytes mean


@dataclass(frozen=True)
class Span:
    """Where an entry's bytes lie in the file."""

    start: int
    size: int
    crc: int


def write_container(path: Path, entries: Mapping[str, bytes]) -> None:
    """Writes the entries in the order given, to a temporary file that then takes the name `path`.

    The same entries give the same bytes. When anything fails, `path` is as it was.
    """
    with replacing(path) as temporary, open(temporary, "wb") as file:
        put_entries(file, entries)


def put_entries(file: BinaryIO, entries: Mapping[str, bytes]) -> None:
    """Writes the entries into an open, empty file."""
    directory = b""
    for name, data in entries.items():
        raw, crc, offset = name.encode("ascii"), zlib.crc32(data), file.tell()
        padding = -(offset + LOCAL.size + len(raw) + 4) % ALIGNMENT
        extra = struct.pack("<HH", PADDING_ID, padding) + bytes(padding)
        common = (0, 0, 0, DOS_EPOCH, crc, len(data), len(data), len(raw))
        file.write(LOCAL.pack(LOCAL_MAGIC, VERSION_NEEDED, *common, len(extra)) + raw + extra)
        file.write(data)
        directory += CENTRAL.pack(
            CENTRAL_MAGIC, VERSION_NEEDED, VERSION_NEEDED, *common, 0, 0, 0, 0, 0, offset
        )
        directory += raw
    start, count = file.tell(), len(entries)
    file.write(directory)
    file.write(END.pack(END_MAGIC, 0, 0, count, count, len(directory), start, 0))


class Container:
    """An open `.cap4d` file. Use as a context manager.

    Args:
        path: The file.
        names: The entry names that may occur.
    Raises:
        DataError: It is not there, too large, cut short, or not the zip subset of FORMAT.md.
    """

    def __init__(self, path: Path, names: Collection[str]) -> None:
        self.path, self.names = path, names
        if not path.is_file():
            found = "a folder" if path.is_dir() else "no such file"
            raise DataError(path, "file", expected="a .cap4d file", found=found)
        self.file = open(path, "rb")  # noqa: SIM115 (closed by __exit__)
        try:
            self.spans = self._read_directory()
        except BaseException:
            self.file.close()
            raise

    def __enter__(self) -> Container:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def read(self, name: str) -> bytes:
        """The bytes of an entry that is in `spans`."""
        span = self.spans[name]
        self.file.seek(span.start)
        data = self.file.read(span.size)
        self._expect(len(data) == span.size, name, f"{span.size} bytes", len(data))
        return data

    def check_crc(self, name: str, data: bytes) -> None:
        """For the entry that holds everybody else's hashes but not its own."""
        self._expect(
            zlib.crc32(data) == self.spans[name].crc, f"{name}: crc32", self.spans[name].crc, zlib.crc32(data)
        )

    def _read_directory(self) -> dict[str, Span]:
        size = os.fstat(self.file.fileno()).st_size
        self._expect(size <= MAX_FILE_BYTES, "size", f"at most {MAX_FILE_BYTES} bytes", size)
        self._expect(size >= END.size, "zip end record", f"at least {END.size} bytes", size)
        end = END.unpack(self._bytes(size - END.size, END.size))
        found = end[0]
        self._expect(
            found == END_MAGIC, "zip end record", f"{END_MAGIC!r} (the file may be cut)", repr(found)
        )
        _, disk, first_disk, here, count, length, start, comment = end
        self._expect(
            (disk, first_disk, comment) == (0, 0, 0), "zip end record", "one disk, no comment", end[1:]
        )
        self._expect(here == count <= MAX_ENTRIES, "zip entries", f"at most {MAX_ENTRIES}", max(here, count))
        self._expect(
            start + length == size - END.size, "zip directory", f"end at {size - END.size}", start + length
        )
        return self._parse_directory(self._bytes(start, length), count, start)

    def _parse_directory(self, directory: bytes, count: int, limit: int) -> dict[str, Span]:
        spans: dict[str, Span] = {}
        at = 0
        for _ in range(count):
            fits = at + CENTRAL.size <= len(directory)
            self._expect(fits, "zip directory", f"{count} entries", f"{len(spans)} in {len(directory)} bytes")
            field = CENTRAL.unpack_from(directory, at)
            self._expect(field[0] == CENTRAL_MAGIC, "zip directory", repr(CENTRAL_MAGIC), repr(field[0]))
            at += CENTRAL.size
            name = directory[at : at + field[10]].decode("ascii", "backslashreplace")
            at += field[10] + field[11] + field[12]
            self._expect(
                name in self.names, "entry name", f"one of {', '.join(sorted(self.names))}", repr(name)
            )
            self._expect(name not in spans, name, "one entry of this name", "two")
            spans[name] = self._span(name, flags=field[3], method=field[4], crc=field[7], sizes=field[8:10],
                                     offset=field[16], limit=limit)  # fmt: skip
        self._expect(at == len(directory), "zip directory", f"{at} bytes", len(directory))
        self._refuse_overlap(spans)
        return spans

    def _span(
        self, name: str, *, flags: int, method: int, crc: int, sizes: tuple[int, int], offset: int, limit: int
    ) -> Span:
        self._expect(method == 0, f"{name}: compression", "0 (stored)", method)
        self._expect(
            flags in NAME_FLAGS, f"{name}: zip flags", "no encryption, no data descriptor", hex(flags)
        )
        self._expect(sizes[0] == sizes[1], f"{name}: size", f"{sizes[1]} bytes stored", sizes[0])
        self._expect(offset + LOCAL.size <= limit, f"{name}: offset", f"before {limit}", offset)
        local = LOCAL.unpack(self._bytes(offset, LOCAL.size))
        raw = self._bytes(offset + LOCAL.size, min(local[9], limit))
        same = local[0] == LOCAL_MAGIC and raw == name.encode() and local[2:4] == (flags, method)
        same = same and local[6:9] == (crc, *sizes)
        self._expect(same, f"{name}: local header", "the directory's", "another")
        start = offset + LOCAL.size + local[9] + local[10]
        self._expect(start + sizes[1] <= limit, f"{name}: end", f"at most {limit}", start + sizes[1])
        return Span(start, sizes[1], crc)

    def _refuse_overlap(self, spans: dict[str, Span]) -> None:
        end = 0
        for name, span in sorted(spans.items(), key=lambda item: item[1].start):
            self._expect(span.start >= end, f"{name}: start", f"at least {end} (no overlap)", span.start)
            end = span.start + span.size

    def _bytes(self, start: int, size: int) -> bytes:
        self.file.seek(start)
        return self.file.read(size)

    def _expect(self, holds: bool, field: str, expected: object, found: object) -> None:
        if not holds:
            raise DataError(self.path, field, expected=str(expected), found=found)
