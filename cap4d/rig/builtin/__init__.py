"""The built-in head: a friendly human head modelled by this code alone, so that everything works with nothing
downloaded.

field.py is its form, skin.py the mesh of its skin, parts.py what is set into it, paint.py its colours,
identity.py and expressions.py how it varies and moves, atlas.py its UVs.
"""

from __future__ import annotations

import numpy as np

from cap4d.rig.builtin.atlas import left_uv, right_uv
from cap4d.rig.builtin.expressions import expression_modes
from cap4d.rig.builtin.field import EYE
from cap4d.rig.builtin.identity import identity_modes
from cap4d.rig.builtin.paint import paint
from cap4d.rig.builtin.parts import build_ear, build_eye, build_hair, build_shirt, build_teeth, build_tongue
from cap4d.rig.builtin.sheet import Mesh, assemble, smoothstep
from cap4d.rig.builtin.skin import CORNER_COLUMN, build_skin, row_of
from cap4d.rig.head import HeadRig

NECK = np.array([0.0, -78.0, -30.0])  # mm; where the neck bends under the head
MM = 1e-3


def build_mesh() -> Mesh:
    """The neutral head in millimetres, with the marks its parts carry."""
    teeth = (
        build_teeth("teeth_upper", 1, 24, 79, -55, -44),
        build_teeth("teeth_lower", -1, 22, 76.5, -55.3, -63.5),
    )
    parts = [*build_skin(), build_eye(), *teeth, build_tongue(), build_ear(), build_hair(), build_shirt()]
    return assemble([paint(p) for p in parts], left_uv, right_uv)


def skin_weights(mesh: Mesh) -> np.ndarray:
    """[V, 3] neck, left eye, right eye; the neck's share grows from the jaw line to the shirt."""
    y, z = mesh.points[:, 1], mesh.points[:, 2]
    neck = smoothstep(-70, -170, y + 35 * smoothstep(0, 60, z)) * mesh.of("skin")
    neck[mesh.of("shirt")] = 1
    eye, left = mesh.of("eye"), mesh.points[:, 0] > 0
    return np.stack([neck, eye & left, eye & ~left], -1)


def regions(mesh: Mesh) -> dict[str, np.ndarray]:
    """Named vertex ids; see `HeadRig.regions`."""
    row, column = mesh.marks["row"], mesh.marks["column"]
    skin, rigid = mesh.of("skin"), mesh.of("eye", "teeth_upper", "teeth_lower", "shirt")
    lips = (
        skin
        & (row >= row_of("upper_vermilion"))
        & (row <= row_of("lower_vermilion"))
        & (column <= CORNER_COLUMN)
    )
    masks = {
        "head": ~mesh.of("shirt") & ~(skin & (row > row_of("throat"))),
        "deformable": ~rigid,
        "eyes": mesh.of("eye"),
        "teeth": mesh.of("teeth_upper", "teeth_lower"),
        "mouth": mesh.of("mouth", "tongue"),
        "bust": mesh.of("shirt"),
        "scalp": mesh.of("hair") | (skin & (row <= row_of("hair"))),
        "hair": mesh.of("hair"),
        "lips": lips,
        "ears": mesh.of("ear"),
    }
    return {name: np.flatnonzero(mask).astype(np.int32) for name, mask in masks.items()}


def build_head() -> HeadRig:
    """The built-in rig: 28 identity modes, the 52 ARKit expressions, neck and eyes, colours. The same bits
    every time.
    """
    mesh = build_mesh()
    joints = np.stack([NECK, EYE, EYE * [-1, 1, 1]])
    identity, joints_identity, _ = identity_modes(mesh, joints)
    expressions, names = expression_modes(mesh)
    return HeadRig(
        name="builtin",
        licence="Apache-2.0",
        template=_metres(mesh.points),
        faces=mesh.faces.astype(np.int32),
        uvs=mesh.uvs.astype(np.float32),
        uv_faces=mesh.uv_faces.astype(np.int32),
        identity_basis=_metres(identity),
        expression_basis=_metres(expressions),
        expression_names=names,
        expression_range=np.tile(np.array([0, 1], np.float32), (len(names), 1)),
        joint_names=("neck", "eye_left", "eye_right"),
        joint_drivers=("neck", "eyes", "eyes"),
        joints=_metres(joints),
        joints_identity=_metres(joints_identity),
        joints_expression=np.zeros((len(names), 3, 3), np.float32),
        skin_weights=skin_weights(mesh).astype(np.float32),
        colors=np.clip(mesh.colors, 0, 1).astype(np.float32),
        regions=regions(mesh),
    )


def _metres(mm: np.ndarray) -> np.ndarray:
    return (mm * MM).astype(np.float32)
