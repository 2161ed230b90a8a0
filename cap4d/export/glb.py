"""Gaussians as a .glb with glTF's ratified extension KHR_gaussian_splatting; all float32, nothing is lost.

glTF's axes: y up, the front to +z. What does not know the extension shows points, coloured (`COLOR_0`).
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from cap4d.color import linear_from_srgb
from cap4d.export.axes import unit_quats, y_up
from cap4d.gaussians import Gaussians
from cap4d.harmonics import SH_0

EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS, VERTICES = 5126, 0, 34962  # glTF's numbers for them
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942


def glb_bytes(gaussians: Gaussians) -> bytes:
    """The file."""
    attributes = _attributes(y_up(gaussians))
    binary = b"".join(array.tobytes() for array in attributes.values())  # whole float32s: always aligned
    text = json.dumps(_document(attributes), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = _chunk(JSON_CHUNK, text) + _chunk(BINARY_CHUNK, binary)
    return struct.pack("<3I", MAGIC, VERSION, 12 + len(chunks)) + chunks


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """float32[N, 1 | 3 | 4] by the names of the extension, and the points' colours."""
    arrays = {
        "POSITION": gaussians.means,
        f"{EXTENSION}:ROTATION": np.roll(unit_quats(gaussians), -1, 1),  # xyzw
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": np.clip(gaussians.opacities, 0, 1)[:, None],
        "COLOR_0": _colors(gaussians),
    }
    for degree in range(gaussians.sh_degree + 1):
        for order in range(2 * degree + 1):
            arrays[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = gaussians.sh[:, degree**2 + order]
    return {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()}


def _colors(gaussians: Gaussians) -> np.ndarray:
    """[N, 4]: linear light, as glTF has it, of no direction in particular; opacity."""
    rgb = linear_from_srgb(np.clip(0.5 + SH_0 * gaussians.sh[:, 0].astype(np.float64), 0, 1))
    return np.concatenate([rgb, np.clip(gaussians.opacities, 0, 1)[:, None]], 1)


def _document(attributes: dict[str, np.ndarray]) -> dict[str, Any]:
    offsets = np.cumsum([0, *(array.nbytes for array in attributes.values())]).tolist()
    views = [
        {"buffer": 0, "byteOffset": at, "byteLength": array.nbytes, "target": VERTICES}
        for at, array in zip(offsets, attributes.values(), strict=False)
    ]
    accessors: list[dict[str, Any]] = [
        {"bufferView": i, "componentType": FLOAT, "count": len(array), "type": TYPES[array.shape[1]]}
        for i, array in enumerate(attributes.values())
    ]
    means = attributes["POSITION"]
    accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(attributes)},
        "extensions": {EXTENSION: extension},
    }
    return {
        "asset": {"version": "2.0", "generator": "cap4d"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _chunk(kind: int, data: bytes) -> bytes:
    return struct.pack("<2I", len(data), kind) + data
