"""The files of a GaussianAvatars avatar, invented, and FLAME with its kinematic chain in float64: what a
reader of them must agree with. Written from the model's paper (Li et al. 2017), not from the reader.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.rig.flame import FlameModel
from cap4d.rotation import axis_angle_to_rotmat

PARENTS = (-1, 0, 1, 1, 1)
FLOATS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")


@dataclass(frozen=True, eq=False)
class Invented:
    """Parameters by their names in `flame_param.npz`, and the table of the PLY."""

    params: dict[str, np.ndarray]
    table: np.ndarray

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Writes both files; returns their paths."""
        ply, params = folder / "point_cloud.ply", folder / "flame_param.npz"
        write_ply(ply, self.table)
        np.savez(params, **self.params)
        return ply, params


def invent(
    *, faces: int, vertices: int, gaussians: int = 300, frames: int = 5, degree: int = 3, seed: int = 0
) -> Invented:
    """An avatar with everything at once: identity, offsets, a turning head, neck, jaw and two eyes.

    Args:
        faces: Gaussians are bound to these, the first and the last included.
    """
    rng = np.random.default_rng(seed)
    turn = lambda size, width=3: rng.normal(size=(frames, width)) * size  # noqa: E731
    params = {
        "shape": 0.5 * rng.normal(size=300),
        "expr": turn(0.5, 100),
        "rotation": np.array([0.1, 0.4, -0.2]) + turn(0.1),
        "neck_pose": turn(0.2),
        "jaw_pose": np.abs(turn(0.15)) * [1, 0.1, 0.1],
        "eyes_pose": np.tile(turn(0.2), 2),
        "translation": np.array([0.1, -0.2, 0.4]) + turn(0.05),
        "static_offset": 1e-3 * rng.normal(size=(vertices, 3)),
        "dynamic_offset": np.zeros((frames, vertices, 3)),
    }
    names = [*FLOATS, *(f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))), "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)] + ["binding_0"]
    table = np.zeros(gaussians, [(name, "<f4") for name in names])
    for name in names:
        table[name] = rng.normal(size=gaussians) * (0.3 if name.startswith("f_") else 1)
    for name in ("scale_0", "scale_1", "scale_2"):
        table[name] = rng.uniform(-1.5, 0, gaussians)
    table["binding_0"] = rng.integers(faces, size=gaussians)
    table["binding_0"][:2] = 0, faces - 1
    return Invented({name: value.astype(np.float32) for name, value in params.items()}, table)


def write_ply(path: Path, table: np.ndarray, *, header: str | None = None) -> None:
    """A binary PLY of one element; `header` in place of the right one."""
    if header is None:
        lines = [f"property float {name}" for name in table.dtype.names]
        start = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
        header = "\n".join([*start, *lines, "end_header", ""])
    path.write_bytes(header.encode() + table.tobytes())


def chained_vertices(flame: FlameModel, params: dict[str, np.ndarray], frame: int) -> np.ndarray:
    """float64[V, 3] m, FLAME's world: linear blend skinning along the chain (Li et al. 2017, eqs. 1 to 5)."""
    p = {name: value.astype(np.float64) for name, value in params.items()}
    shape, expr = p["shape"], p["expr"][frame]
    shaped = flame.template + flame.shapedirs[..., :300] @ shape + flame.shapedirs[..., 300:400] @ expr
    shaped = shaped + p["static_offset"]
    joints = flame.joint_regressor @ shaped
    eyes = p["eyes_pose"][frame].reshape(2, 3)
    turns = [p["rotation"][frame], p["neck_pose"][frame], p["jaw_pose"][frame], *eyes]
    rotmats = axis_angle_to_rotmat(np.array(turns))
    corrected = shaped + flame.posedirs @ (rotmats[1:] - np.eye(3)).ravel()
    chain = []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotmats[joint]
        local[:3, 3] = joints[joint] - rotmats[joint] @ joints[joint]  # about the joint's place at rest
        chain.append(local if parent < 0 else chain[parent] @ local)
    blended = np.einsum("vj,jrc->vrc", flame.weights, np.array(chain))
    posed = np.einsum("vrc,vc->vr", blended[:, :3, :3], corrected) + blended[:, :3, 3]
    return posed + p["translation"][frame]
