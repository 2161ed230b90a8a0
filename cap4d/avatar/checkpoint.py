"""Checkpoints of a fit: tensors and plain values, written whole or not at all, read weights-only.

A line with a checksum, then what `torch.save` writes. The one before is kept beside the newest, so that a
file that the disk spoiled costs some steps and not the fit.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
from pathlib import Path
from typing import Any

import torch

from cap4d.atomic import replacing
from cap4d.errors import DataError

log = logging.getLogger(__name__)

MAGIC = b"cap4d fit 1 "
HEADER_BYTES = len(MAGIC) + 64 + 1  # hexadecimal SHA-256, line feed


def previous_of(path: Path) -> Path:
    """Where the checkpoint before the newest is kept."""
    return path.with_name(f"{path.name}.previous")


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Writes `state` through a temporary file and a rename; what was there becomes the previous one."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getbuffer()
    with replacing(path) as temporary:
        with open(temporary, "wb") as file:
            file.write(MAGIC + hashlib.sha256(payload).hexdigest().encode() + b"\n")
            file.write(payload)
        if path.exists():  # a kill between the two renames leaves the previous one alone
            os.replace(path, previous_of(path))


def load_checkpoint(path: Path, *, kind: str) -> dict[str, Any]:
    """Reads a checkpoint.

    Args:
        kind: What `state["kind"]` must be: preset, rig, seed and so on of the fit that goes on.
    Raises:
        DataError: It is no checkpoint, or one of another fit.
    """
    state = _read(path)
    if not isinstance(state, dict) or "kind" not in state:
        raise DataError(path, "checkpoint", expected="a fit's state", found=type(state).__name__)
    if state["kind"] != kind:
        raise DataError(path, "kind", expected=kind, found=state["kind"])
    return state


def load_latest(path: Path, *, kind: str) -> dict[str, Any] | None:
    """The newest checkpoint that is whole; None where there is none. See `load_checkpoint`.

    Raises:
        DataError: All there are are spoiled, or the one to be used is of another fit.
    """
    found = [p for p in (path, previous_of(path)) if p.exists()]
    for i, candidate in enumerate(found):
        try:
            return load_checkpoint(candidate, kind=kind)
        except DataError as error:
            if error.field != "checkpoint" or i == len(found) - 1:
                raise
            log.warning("%s; taking the one before it", error)
    return None


def remove_checkpoints(path: Path) -> None:
    """Removes the newest, the previous, and what a killed fit had begun to write."""
    begun = path.parent.glob(f".{path.name}.*.partial")
    for file in (path, previous_of(path), *begun):
        file.unlink(missing_ok=True)


def _read(path: Path) -> Any:
    data = path.read_bytes()
    header, payload = data[:HEADER_BYTES], data[HEADER_BYTES:]
    if not header.startswith(MAGIC):
        found = f"{header[:16]!r}"
        raise DataError(path, "checkpoint", expected="tensors written by an earlier fit", found=found)
    if header != MAGIC + hashlib.sha256(payload).hexdigest().encode() + b"\n":
        raise DataError(path, "checkpoint", expected="bytes as they were written", found="others")
    try:
        return torch.load(io.BytesIO(payload), weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises whatever its unpickler, zip reader and storages raise
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise DataError(
            path, "checkpoint", expected="tensors written by an earlier fit", found=reason
        ) from error
