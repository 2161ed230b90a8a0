"""Checkpoints of a fit: tensors and plain values, written whole or not at all, read weights-only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from cap4d.atomic import replacing
from cap4d.errors import DataError


def save_checkpoint(state: dict[str, Any], path: Path) -> None:
    """Writes `state` through a temporary file and a rename."""
    with replacing(path) as temporary:
        torch.save(state, temporary)


def load_checkpoint(path: Path, *, kind: str) -> dict[str, Any]:
    """Reads a checkpoint.

    Args:
        kind: What `state["kind"]` must be: preset, rig, seed and so on of the fit that goes on.
    Raises:
        DataError: It is no checkpoint, or one of another fit.
    """
    try:
        state = torch.load(path, weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler, zip reader and storages raise
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise DataError(
            path, "checkpoint", expected="tensors written by an earlier fit", found=reason
        ) from error
    if not isinstance(state, dict) or "kind" not in state:
        raise DataError(path, "checkpoint", expected="a fit's state", found=type(state).__name__)
    if state["kind"] != kind:
        raise DataError(path, "kind", expected=kind, found=state["kind"])
    return state
