"""FLAME 2020 and 2023 (Li et al. 2017) as a HeadRig, with the released CAP4D system's additions where its
assets are given.

The additions (facts 1-15): 65 expressions of which the last is a blink, two half-spheres for the mouth,
texture coordinates, a neck that bends under a fixed head, and the constant offset that the released fits were
made with.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.errors import DataError
from cap4d.rig import paint
from cap4d.rig.head import HeadRig, MouthPlacement
from cap4d.rig.npz import checked, checked_indices, read_npy
from cap4d.rig.obj import read_obj, triangulate
from cap4d.rig.unpickle import read_pickle

N_VERTICES, N_FACES = 5023, 9976
N_IDENTITY, N_FILE_IDENTITY = 150, 300  # used (fact 3), and before the expressions in `shapedirs` (fact 2)
N_EXPRESSIONS, BLINK = 65, 64  # with the assets (facts 3, 4)
LIP_VERTEX = 3533  # fact 12
EYES_FROM = 3931  # the eyeballs are the last vertices, one after the other

# FLAME's joints: 0 root, 1 neck, 2 jaw, 3 left eye, 4 right eye. The root bends as the neck, FLAME's neck
# never turns (fact 6). These four, in this order, are also the slots of the pose correctives (fact 8).
JOINTS = {"neck": (0, "neck"), "jaw": (2, "jaw"), "eye_left": (3, "eyes"), "eye_right": (4, "eyes")}

# Half-sphere of 10 rings of 20 points, of a sphere of 20 latitudes (fact 12). It is a bowl that bulges to the
# lips.
N_RINGS, N_AROUND, N_LATITUDES = 10, 20, 20
N_MOUTH = N_RINGS * N_AROUND

RELEASED_RIG = "flame2023_no_jaw"  # the rig of the released system, and of its files that name none
EDITIONS_WITH_JAW = {
    "generic_model": "flame2020",
    "flame2020": "flame2020",
    "flame2023": "flame2023",
}  # by file name


@dataclass(frozen=True, eq=False)
class Assets:
    """The released assets: `blink` [5023, 3] m, `jaw_regressor` [65, 3] rad, texture, vertex lists."""

    blink: np.ndarray
    jaw_regressor: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    uv_faces: np.ndarray
    head: np.ndarray
    deformable: np.ndarray


@dataclass(frozen=True, eq=False)
class FlameModel:
    """The arrays of a FLAME file (fact 2), float64: `shapedirs` [5023, 3, K], `posedirs` [5023, 3, 36]."""

    template: np.ndarray
    faces: np.ndarray
    shapedirs: np.ndarray
    posedirs: np.ndarray
    joint_regressor: np.ndarray
    weights: np.ndarray


def import_flame(model: Path, assets: Path | None = None, *, compat_pose_offset: bool = True) -> HeadRig:
    """Makes a rig of a FLAME pickle.

    Editions with a jaw of their own are known by their files' names (`generic_model.pkl` is FLAME 2020);
    there the lower mouth turns with `jaw_rot`. Any other model with the released assets, whatever its file
    is called, is `flame2023_no_jaw`, where it turns with the expression (fact 13).

    Args:
        model: FLAME's .pkl.
        assets: Folder with the released system's assets, or None for the bare model: no texture, so no UV
            grid.
        compat_pose_offset: Keep the constant offset of the released evaluation (fact 8), which its fits
            expect.
    Raises:
        DataError: One line that names the file, the field, what was expected and what was found.
    """
    model, stem = Path(model), Path(model).stem
    flame = read_flame(model)
    name = EDITIONS_WITH_JAW.get(stem, stem if assets is None else RELEASED_RIG)
    rig = _bare_rig(flame, name, compat_pose_offset)
    if assets is None:
        return rig
    return _with_assets(rig, read_assets(Path(assets), flame.faces), flame, own_jaw=stem in EDITIONS_WITH_JAW)


def read_flame(path: Path) -> FlameModel:
    """Reads and checks a FLAME pickle."""
    content = read_pickle(path)
    n = N_VERTICES
    floats = {
        "v_template": (n, 3),
        "shapedirs": (n, 3, None),
        "posedirs": (n, 3, 36),
        "J_regressor": (5, n),
        "weights": (n, 5),
    }
    template, shapedirs, posedirs, regressor, weights = (
        _float64(path, name, content.get(name), shape) for name, shape in floats.items()
    )
    if shapedirs.shape[2] < N_FILE_IDENTITY + N_EXPRESSIONS:
        raise DataError(path, "shapedirs", expected="at least 365 components", found=shapedirs.shape[2])
    if weights.min() < -1e-6 or abs(weights.sum(1) - 1).max() > 1e-3:
        raise DataError(
            path,
            "weights",
            expected="rows that sum to 1",
            found=f"{weights.sum(1).min():.4g} to {weights.sum(1).max():.4g}",
        )
    faces = checked_indices(path, "f", _is_array(content.get("f")), shape=(N_FACES, 3), below=n)
    return FlameModel(template, faces, shapedirs, posedirs, regressor, weights)


def read_assets(folder: Path, faces: np.ndarray) -> Assets:
    """Reads and checks the released assets; `faces` are the model's, which the template must share."""
    obj = folder / "cap4d_avatar_template.obj"
    mesh = read_obj(obj)
    n = N_VERTICES + 2 * N_MOUTH
    checked(obj, "v", mesh.vertices, kind="float", shape=(n, 3))
    template_faces, uv_faces = triangulate(mesh.faces, mesh.uv_faces)
    if not np.array_equal(template_faces[:N_FACES], faces):
        raise DataError(obj, "f", expected="the model's faces first", found="others")
    if mesh.uvs.min() < 0 or mesh.uvs.max() > 1:
        raise DataError(obj, "vt", expected="0 to 1", found=f"{mesh.uvs.min():.4g} to {mesh.uvs.max():.4g}")
    blink, jaw = folder / "blink_blendshape.npy", folder / "jaw_regressor.npy"
    return Assets(
        blink=_float64(blink, "array", read_npy(blink), (N_VERTICES, 3)),
        jaw_regressor=_float64(jaw, "array", read_npy(jaw), (N_EXPRESSIONS, 3)),
        faces=template_faces,
        uvs=mesh.uvs,
        uv_faces=uv_faces,
        head=_read_ids(folder / "head_vertices.txt", below=n),
        deformable=_read_ids(folder / "deformable_verts.txt", below=n),
    )


def half_sphere() -> np.ndarray:
    """float64[200, 3] the mouth's bowl around the origin, radius 1, its bottom at +z (fact 12)."""
    latitude = (-np.pi / 2 + np.arange(N_RINGS) * np.pi / (N_LATITUDES - 1))[:, None]
    longitude = np.linspace(0, 2 * np.pi, N_AROUND)
    rings = [
        np.cos(latitude) * np.cos(longitude),
        -np.cos(latitude) * np.sin(longitude),
        -np.sin(latitude) + 0 * longitude,
    ]
    return np.stack(rings, -1).reshape(-1, 3)


def _bare_rig(flame: FlameModel, name: str, compat_pose_offset: bool) -> HeadRig:
    basis = flame.shapedirs.transpose(2, 0, 1)
    identity, expression = basis[:N_IDENTITY], basis[N_FILE_IDENTITY:]
    slots = [slot for slot, _ in JOINTS.values()]
    regressor = flame.joint_regressor[slots]
    pose_basis = flame.posedirs.transpose(2, 0, 1)
    diagonal = [9 * slot + entry for slot in range(len(JOINTS)) for entry in (0, 4, 8)]
    weights = flame.weights[:, slots]
    upper = np.flatnonzero(weights[:, 0] < 0.5).astype(np.int32)
    has_correctives = bool(np.abs(pose_basis).max() > 0)
    return HeadRig(
        name=name,
        licence="LicenseRef-FLAME",
        template=flame.template.astype(np.float32),
        faces=flame.faces,
        uvs=np.zeros((0, 2), np.float32),
        uv_faces=np.zeros((0, 3), np.int32),
        identity_basis=identity.astype(np.float32),
        expression_basis=expression.astype(np.float32),
        expression_names=tuple(f"expr{i:02d}" for i in range(len(expression))),
        expression_range=np.tile(np.float32([-3, 3]), (len(expression), 1)),
        joint_names=tuple(JOINTS),
        joint_drivers=tuple(driver for _, driver in JOINTS.values()),
        joints=(regressor @ flame.template).astype(np.float32),
        joints_identity=(regressor @ identity).astype(np.float32),
        joints_expression=(regressor @ expression).astype(np.float32),
        skin_weights=weights.astype(np.float32),
        pose_basis=pose_basis.astype(np.float32) if has_correctives else None,
        pose_offset=-pose_basis[diagonal].sum(0).astype(np.float32)
        if compat_pose_offset and has_correctives
        else None,
        colors=_colors(flame.template, regressor @ flame.template),
        regions={
            "head": upper,
            "deformable": upper,
            "eyes": np.arange(EYES_FROM, N_VERTICES, dtype=np.int32),
        },
    )


def _with_assets(rig: HeadRig, assets: Assets, flame: FlameModel, *, own_jaw: bool) -> HeadRig:
    """The rig with blink, texture and mouth. Mouth vertices follow no blendshape; MouthPlacement puts them in
    place.
    """
    expression = rig.expression_basis[:N_EXPRESSIONS].copy()
    expression[BLINK] = assets.blink
    joints_expression = (flame.joint_regressor[[slot for slot, _ in JOINTS.values()]] @ expression).astype(
        np.float32
    )
    mouth = _mouth(flame)
    lower = np.arange(N_VERTICES + N_MOUTH, N_VERTICES + 2 * N_MOUTH)
    weights = np.zeros((N_VERTICES + 2 * N_MOUTH, len(JOINTS) + 1), np.float32)
    weights[:N_VERTICES, : len(JOINTS)] = rig.skin_weights
    jaw = rig.joint_names.index("jaw")
    weights[lower, jaw if own_jaw else -1] = 1
    both = {
        "identity_basis": rig.identity_basis,
        "expression_basis": expression,
        "pose_basis": rig.pose_basis,
    }
    padded = {name: _padded(array) for name, array in both.items()}
    if padded["pose_basis"] is not None:
        nothing = np.zeros((9, *padded["pose_basis"].shape[1:]), np.float32)
        padded["pose_basis"] = np.concatenate([padded["pose_basis"], nothing])
    ranges = rig.expression_range[:N_EXPRESSIONS].copy()
    ranges[BLINK] = -0.7, 1  # fact 4
    mouth_ids = np.arange(N_VERTICES, N_VERTICES + 2 * N_MOUTH, dtype=np.int32)
    return HeadRig(
        name=rig.name,
        licence="LicenseRef-FLAME AND CC-BY-NC-4.0",
        template=_padded(rig.template) + mouth.place(np.zeros(N_IDENTITY, np.float32)),
        faces=assets.faces,
        uvs=assets.uvs.astype(np.float32),
        uv_faces=assets.uv_faces,
        expression_names=(*rig.expression_names[:BLINK], "blink"),
        expression_range=ranges,
        joint_names=(*rig.joint_names, "lower_mouth"),
        joint_drivers=(*rig.joint_drivers, "expr"),
        joints=_with_copy(rig.joints, jaw),
        joints_identity=_with_copy(rig.joints_identity, jaw),
        joints_expression=np.concatenate(
            [joints_expression, 0 * joints_expression[:, :1]], 1
        ),  # fact 12: neutral
        skin_weights=weights,
        expr_rotation=(0 if own_jaw else 1) * assets.jaw_regressor.astype(np.float32),
        pose_offset=_padded(rig.pose_offset),
        mouth=mouth,
        colors=np.concatenate([rig.colors, np.tile(np.float32(paint.CAVITY), (2 * N_MOUTH, 1))]),
        regions={
            "head": assets.head,
            "deformable": assets.deformable,
            "eyes": rig.regions["eyes"],
            "mouth": mouth_ids,
        },
        **padded,
    )


def _mouth(flame: FlameModel) -> MouthPlacement:
    identity = flame.shapedirs.transpose(2, 0, 1)[:N_IDENTITY]
    jaw = flame.joint_regressor[JOINTS["jaw"][0]]
    local = np.zeros((N_VERTICES + 2 * N_MOUTH, 4), np.float32)
    local[N_VERTICES:, :3] = np.tile(half_sphere(), (2, 1))
    local[N_VERTICES:, 3] = 1
    return MouthPlacement(
        local=local,
        anchors=np.stack([jaw @ flame.template, flame.template[LIP_VERTEX]]).astype(np.float32),
        anchors_identity=np.stack([jaw @ identity, identity[:, LIP_VERTEX]], 1).astype(np.float32),
    )


def _padded(array: np.ndarray | None) -> np.ndarray | None:
    """[..., 5023, 3] -> [..., 5423, 3] with zeros for the mouth."""
    if array is None:
        return None
    return np.pad(array, [(0, 0)] * (array.ndim - 2) + [(0, 2 * N_MOUTH), (0, 0)])


def _with_copy(joints: np.ndarray, joint: int) -> np.ndarray:
    """[..., J, 3] -> [..., J + 1, 3] with a copy of one joint at the end."""
    return np.concatenate([joints, joints[..., joint : joint + 1, :]], -2)


def _colors(template: np.ndarray, joints: np.ndarray) -> np.ndarray:
    colors = np.tile(np.array(paint.SKIN), (N_VERTICES, 1))
    eyes = np.arange(EYES_FROM, N_VERTICES)
    for joint, side in ((2, 1), (3, -1)):
        ball = eyes[template[eyes, 0] * side > 0]
        colors[ball] = paint.paint_eye(template[ball], joints[joint])
    return colors.astype(np.float32)


def _is_array(value: object) -> np.ndarray | None:
    return value if isinstance(value, np.ndarray) else None


def _float64(path: Path, name: str, value: object, shape: tuple[int | None, ...]) -> np.ndarray:
    return checked(path, name, _is_array(value), kind="float", shape=shape).astype(np.float64)


def _read_ids(path: Path, *, below: int) -> np.ndarray:
    try:
        ids = np.array(path.read_text().split(), np.int64)
    except OSError as error:
        raise DataError(path, "file", expected="vertex ids, one a line", found=error.strerror) from error
    except ValueError as error:
        raise DataError(path, "ids", expected="integers", found=error) from error
    return checked_indices(path, "ids", ids, shape=(None,), below=below)
