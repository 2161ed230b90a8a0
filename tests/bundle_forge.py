"""Takes a sound bundle apart and puts it together wrongly, with hashes that fit: what an attacker can do."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from safetensors.numpy import load, save

from cap4d.bundle.container import write_container
from cap4d.bundle.manifest import digest
from cap4d.bundle.schema import MANIFEST, ONNX


class Forge:
    """A bundle in pieces: `entries` (bytes by name) and the `manifest` as a dictionary."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            self.entries = {name: archive.read(name) for name in archive.namelist()}
        self.manifest = json.loads(self.entries.pop(MANIFEST))
        self.raw_manifest: bytes | None = None

    def tensors(self, entry: str, change: Callable[[dict[str, np.ndarray]], object]) -> None:
        """Lets `change` edit the tensors of an entry."""
        arrays = {name: value.copy() for name, value in load(self.entries[entry]).items()}
        change(arrays)
        self.entries[entry] = save({name: np.ascontiguousarray(value) for name, value in arrays.items()})

    def network(self, change: Callable[[object], object]) -> None:
        """Lets `change` edit the network's ModelProto."""
        import onnx

        model = onnx.load_from_string(self.entries[ONNX])
        change(model)
        self.entries[ONNX] = model.SerializeToString()

    def sign(self) -> None:
        """Makes the manifest's sizes and hashes those of the entries."""
        self.manifest["entries"] = {
            name: {"size": len(data), "sha256": digest(data)} for name, data in sorted(self.entries.items())
        }

    def all_entries(self) -> dict[str, bytes]:
        manifest = self.raw_manifest
        if manifest is None:
            manifest = json.dumps(self.manifest).encode()
        return {MANIFEST: manifest} | dict(sorted(self.entries.items()))

    def write(self, path: Path) -> None:
        """Writes the pieces as a container."""
        write_container(path, self.all_entries())
