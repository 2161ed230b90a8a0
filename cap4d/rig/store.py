"""Head rigs on disk: one .npz of plain arrays (text as NumPy strings), no pickle. The only place that knows
the layout.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.errors import ArgumentError, DataError
from cap4d.rig.head import JOINT_DRIVERS, HeadRig, MouthPlacement
from cap4d.rig.npz import checked, checked_indices, read_npz, write_npz

FORMAT = "cap4d-rig 1"

# Shapes by letter: V vertices, F faces, T texture vertices, S identity modes, E expressions, J joints. A
# letter is bound by the first array that has it.
_FLOATS = {
    "template": "V3",
    "uvs": "T2",
    "identity_basis": "SV3",
    "expression_basis": "EV3",
    "expression_range": "E2",
    "joints": "J3",
    "joints_identity": "SJ3",
    "joints_expression": "EJ3",
    "skin_weights": "VJ",
}
_OPTIONAL_FLOATS = {"expr_rotation": "E3", "pose_basis": "PV3", "pose_offset": "V3", "colors": "V3"}
_MOUTH = {"local": "V4", "anchors": "23", "anchors_identity": "S23"}
_TEXTS = {"expression_names": "E", "joint_names": "J", "joint_drivers": "J"}


def save_rig(rig: HeadRig, path: Path) -> None:
    """Writes the rig as `path` (.npz), through a temporary file."""
    arrays = {"format": np.array(FORMAT), "name": np.array(rig.name), "licence": np.array(rig.licence)}
    for name in _FLOATS:
        arrays[name] = np.asarray(getattr(rig, name), np.float32)
    for name in _OPTIONAL_FLOATS:
        if getattr(rig, name) is not None:
            arrays[name] = np.asarray(getattr(rig, name), np.float32)
    for name in _TEXTS:
        arrays[name] = np.array(getattr(rig, name), np.str_)
    for name in ("faces", "uv_faces"):
        arrays[name] = np.asarray(getattr(rig, name), np.int32)
    if rig.mouth is not None:
        arrays |= {f"mouth/{name}": np.asarray(getattr(rig.mouth, name), np.float32) for name in _MOUTH}
    arrays |= {f"regions/{name}": np.asarray(ids, np.int32) for name, ids in rig.regions.items()}
    path = Path(path)
    if not path.parent.is_dir():
        raise ArgumentError(f"{path}: its folder does not exist")
    write_npz(path, arrays)


def load_rig(path: Path) -> HeadRig:
    """Reads a rig and checks every array: kind, shape, index range, finite values.

    Raises:
        DataError: One line that names the file, the array, what was expected and what was found.
    """
    path = Path(path)
    arrays = read_npz(path)
    found_format = str(arrays.get("format", "no format entry"))
    if found_format != FORMAT:
        raise DataError(path, "format", expected=FORMAT, found=found_format)
    sizes: dict[str, int] = {}
    values = {
        name: _floats(path, name, arrays.get(name), letters, sizes) for name, letters in _FLOATS.items()
    }
    sizes["P"] = 9 * sizes["J"]
    for name, letters in _OPTIONAL_FLOATS.items():
        values[name] = _floats(path, name, arrays[name], letters, sizes) if name in arrays else None
    for name, letter in _TEXTS.items():
        texts = checked(path, name, arrays.get(name), kind="text", shape=(sizes[letter],))
        values[name] = tuple(texts.tolist())
    values["faces"] = checked_indices(path, "faces", arrays.get("faces"), shape=(None, 3), below=sizes["V"])
    corners = (len(values["faces"]) if sizes["T"] else 0, 3)
    values["uv_faces"] = checked_indices(
        path, "uv_faces", arrays.get("uv_faces"), shape=corners, below=sizes["T"]
    )
    rig = HeadRig(
        name=_text(path, "name", arrays),
        licence=_text(path, "licence", arrays),
        mouth=_mouth(path, arrays, sizes),
        regions=_regions(path, arrays, sizes["V"]),
        **values,
    )
    _check_meaning(path, rig)
    return rig


def _floats(
    path: Path, name: str, array: np.ndarray | None, letters: str, sizes: dict[str, int]
) -> np.ndarray:
    shape = tuple(int(x) if x.isdigit() else sizes.get(x) for x in letters)
    array = checked(path, name, array, kind="float", shape=shape)
    for letter, size in zip(letters, array.shape, strict=True):
        if not letter.isdigit():
            sizes.setdefault(letter, size)
    return np.ascontiguousarray(array, np.float32)


def _text(path: Path, name: str, arrays: dict[str, np.ndarray]) -> str:
    return str(checked(path, name, arrays.get(name), kind="text", shape=()))


def _mouth(path: Path, arrays: dict[str, np.ndarray], sizes: dict[str, int]) -> MouthPlacement | None:
    if "mouth/local" not in arrays:
        return None
    parts = {
        name: _floats(path, f"mouth/{name}", arrays.get(f"mouth/{name}"), s, sizes)
        for name, s in _MOUTH.items()
    }
    return MouthPlacement(**parts)


def _regions(path: Path, arrays: dict[str, np.ndarray], n_vertices: int) -> dict[str, np.ndarray]:
    names = [key.removeprefix("regions/") for key in arrays if key.startswith("regions/")]
    for required in ("head", "deformable"):
        if required not in names:
            raise DataError(
                path, "regions", expected=f"a region {required!r}", found=", ".join(names) or "none"
            )
    return {
        name: checked_indices(
            path, f"regions/{name}", arrays[f"regions/{name}"], shape=(None,), below=n_vertices
        )
        for name in names
    }


def _check_meaning(path: Path, rig: HeadRig) -> None:
    unknown = set(rig.joint_drivers) - set(JOINT_DRIVERS)
    if unknown:
        raise DataError(path, "joint_drivers", expected=" or ".join(JOINT_DRIVERS), found=unknown.pop())
    if "expr" in rig.joint_drivers and rig.expr_rotation is None:
        raise DataError(
            path, "expr_rotation", expected="present, as a joint is driven by expr", found="nothing"
        )
    if len(set(rig.expression_names)) != rig.n_expressions:
        raise DataError(path, "expression_names", expected="different names", found="one of them twice")
    weights = rig.skin_weights
    if weights.size and (weights.min() < -1e-4 or weights.sum(1).max() > 1 + 1e-4):
        found = f"{weights.min():.4g} to {weights.sum(1).max():.4g}"
        raise DataError(path, "skin_weights", expected="at least 0, at most 1 in sum", found=found)
    if (rig.expression_range[:, 0] > rig.expression_range[:, 1]).any():
        raise DataError(path, "expression_range", expected="low, high", found="low above high")
    if rig.uvs.size and (rig.uvs.min() < 0 or rig.uvs.max() > 1):
        raise DataError(path, "uvs", expected="0 to 1", found=f"{rig.uvs.min():.4g} to {rig.uvs.max():.4g}")
