"""ICT-FaceKit Light as it is distributed: a FaceXModel folder of OBJ files, or all of it packed in one .npz.

Centimetres and the model's own axes and vertex order; ict.py makes a rig of it.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.errors import DataError
from cap4d.rig.npz import checked, checked_indices, read_npz
from cap4d.rig.obj import read_obj, read_obj_vertices

N_VERTICES = 26719
NEUTRAL = "generic_neutral_mesh.obj"
LISTING = "vertex_indices.json"

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class IctModel:
    """float32 `neutral` [V, 3], `identity` [S, V, 3] and `expression` [E, V, 3] offsets, cm; quads as in
    `ObjMesh`.
    """

    neutral: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    uv_faces: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    expression_names: tuple[str, ...]


def read_ict(path: Path) -> IctModel:
    """Reads a FaceXModel folder or a packed .npz; a folder may lack files, which are reported in the log.

    Raises:
        DataError: Names the file, the field, what was expected and what was found.
    """
    path = Path(path)
    return _read_folder(path) if path.is_dir() else _read_packed(path)


def _read_packed(path: Path) -> IctModel:
    arrays = read_npz(path)
    names = checked(path, "expression_names", arrays.get("expression_names"), kind="text", shape=(None,))
    n_faces = len(checked(path, "faces", arrays.get("faces"), kind="index", shape=(None, 4)))
    uvs = checked(path, "uv", arrays.get("uv"), kind="float", shape=(None, 2))
    offsets = (N_VERTICES, 3)
    return IctModel(
        neutral=_float32(path, "neutral", arrays, offsets),
        uvs=uvs,
        faces=_quads(path, "faces", arrays, n_faces, N_VERTICES),
        uv_faces=_quads(path, "faces_uv", arrays, n_faces, len(uvs)),
        identity=_float32(path, "identity", arrays, (None, *offsets)),
        expression=_float32(path, "expression", arrays, (len(names), *offsets)),
        expression_names=tuple(names.tolist()),
    )


def _float32(
    path: Path, name: str, arrays: dict[str, np.ndarray], shape: tuple[int | None, ...]
) -> np.ndarray:
    return checked(path, name, arrays.get(name), kind="float", shape=shape).astype(np.float32)


def _quads(path: Path, name: str, arrays: dict[str, np.ndarray], n_faces: int, below: int) -> np.ndarray:
    quads = checked(path, name, arrays.get(name), kind="index", shape=(n_faces, 4)).astype(np.int64)
    checked_indices(path, name, quads[:, :3], shape=(n_faces, 3), below=below)
    return checked_indices(path, name, quads + 1, shape=(n_faces, 4), below=below + 1) - 1


def _read_folder(folder: Path) -> IctModel:
    mesh = read_obj(folder / NEUTRAL)
    checked(folder / NEUTRAL, "v", mesh.vertices, kind="float", shape=(N_VERTICES, 3))
    identities = sorted(folder.glob("identity[0-9][0-9][0-9].obj"))
    for i, file in enumerate(identities):
        if file.name != f"identity{i:03d}.obj":
            raise DataError(
                folder, "identities", expected=f"identity{i:03d}.obj before the next", found=file.name
            )
    listed = _listed_expressions(folder / LISTING)
    names = tuple(name for name in listed if (folder / f"{name}.obj").is_file())
    if not names:
        raise DataError(folder, "expressions", expected=f"an .obj of one listed in {LISTING}", found="none")
    missing = [name for name in listed if name not in names]
    if missing:
        log.warning(
            "%s: %d of %d expressions are missing: %s", folder, len(missing), len(listed), ", ".join(missing)
        )
    log.info("%s: %d identity modes, %d expressions", folder, len(identities), len(names))
    return IctModel(
        neutral=mesh.vertices.astype(np.float32),
        uvs=mesh.uvs,
        faces=mesh.faces,
        uv_faces=mesh.uv_faces,
        identity=_offsets(identities, mesh.vertices),
        expression=_offsets([folder / f"{name}.obj" for name in names], mesh.vertices),
        expression_names=names,
    )


def _listed_expressions(path: Path) -> list[str]:
    try:
        names = json.loads(path.read_text())["expressions"]
    except OSError as error:
        raise DataError(path, "file", expected="a listing of expressions", found=error.strerror) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(path, "expressions", expected="a JSON list of names", found=repr(error)) from error
    if not isinstance(names, list) or not all(
        isinstance(name, str) and name.isidentifier() for name in names
    ):
        raise DataError(path, "expressions", expected="a list of plain names", found=type(names).__name__)
    return names


def _offsets(files: list[Path], neutral: np.ndarray) -> np.ndarray:
    offsets = np.zeros((len(files), *neutral.shape), np.float32)
    for row, file in enumerate(files):
        offsets[row] = (
            checked(file, "v", read_obj_vertices(file), kind="float", shape=neutral.shape) - neutral
        )
    return offsets
