"""Avatars of the released CAP4D code: `chkpntN.pth` (fact 44) -> `.cap4d`.

What it means is facts 16-32: Gaussians on the 28,120 triangles of the UV grid, a U-Net that moves that grid,
and a neck that does not bend. The optimizer's state, two thirds of the file, is never read.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cap4d.avatar.deformer import ENCODING_CHANNELS, Deformer
from cap4d.avatar.model import AvatarModel
from cap4d.bundle.schema import COUNTS
from cap4d.bundle.writer import write_bundle
from cap4d.camera import Camera, head_fixed
from cap4d.drive.clip import Clip
from cap4d.drive.fit import read_sequence
from cap4d.errors import DataError
from cap4d.export.bundle import bundle_of
from cap4d.export.idle import idle_clip
from cap4d.gaussians import SH_COUNTS
from cap4d.player.camera_path import read_cameras
from cap4d.rig.flame import N_EXPRESSIONS, N_IDENTITY, RELEASED_RIG, import_flame
from cap4d.rig.grid import UvGrid, build_grid, remesh
from cap4d.rig.head import HeadRig
from cap4d.rig.npz import checked_float32, checked_indices, read_npz
from cap4d.synth.idle import idle_clip as invented_clip
from cap4d.transfer.raw_gaussians import check_gaussians
from cap4d.transfer.torch_file import TensorRecord, TorchFile

log = logging.getLogger(__name__)

CHECKPOINT = re.compile(r"chkpnt(\d{1,12})\.pth")
KEYS = ("shape", "base_rot", "deform_net", "gaussians")
N_GAUSSIAN_FIELDS = 14
N_FACES = 28_120  # of the released grid (fact 18)
MAX_WIDTH = 256
MAX_NETWORK_VALUES = 1 << 29  # of the widest, with room
DEFAULT_SIZE, DEFAULT_DISTANCE = 512, 1.469153  # px and m of the released sample sequences (fact 47)
DEFAULT_CENTRE = 257.3, 269.5  # px, the same
DEFAULT_FOCAL = 2200.0  # px; theirs is 2605, which cuts hair
CHECKED = {
    "_xyz": ("means", "means"),
    "_rotation": ("quats", "quats"),
    "_scaling": ("log_scales", "log_scales"),
    "_opacity": ("opacity_logits", "opacity_logits"),
    "_features_dc": ("sh", "sh_dc"),
    "_features_rest": ("sh", "sh_rest"),
}
"""Their names -> a bundle's tensor, and ours."""


@dataclass(frozen=True, eq=False)
class OfficialAvatar:
    """A checkpoint, checked; N Gaussians.

    Args:
        iteration: Of the fit.
        shape: float32[150].
        network: The U-Net's state dict, float32.
        gaussians: The raw local Gaussians, float32, by the names of `avatar.model.GAUSSIAN_FIELDS`; the
            harmonics above the degree that was fitted are left out.
        binding: int32[N] into the triangles of fact 18.
    """

    iteration: int
    shape: np.ndarray
    network: dict[str, np.ndarray]
    gaussians: dict[str, np.ndarray]
    binding: np.ndarray

    @property
    def width(self) -> int:
        """Channels of the U-Net's first layer."""
        return len(self.network["model.model.0.weight"])


def import_official(
    model: Path, output: Path, *, flame: Path, assets: Path, clip: Path | None = None
) -> None:
    """Writes `output`, a `.cap4d` file that poses as the released code does.

    Args:
        model: The folder that it wrote, or one `chkpntN.pth`.
        flame: FLAME 2023 without a jaw, the pickle.
        assets: Folder of the released assets.
        clip: A FlowFace sequence for the idle clip and the default view; None: an invented one, and a view
            like that of the released sample sequences.
    Raises:
        DataError: Something is not sound, or of another rig.
    """
    checkpoint = newest_checkpoint(Path(model))
    performance = None if clip is None else read_clip(clip)
    official = read_official(checkpoint)
    log.info("%s: %s", checkpoint, _summary(official))
    rig = released_rig(flame, assets)
    grid = build_grid(rig)
    if len(grid.faces) != N_FACES:
        raise DataError(assets, "template", expected=f"a grid of {N_FACES} faces", found=len(grid.faces))
    idle = invented_clip(rig) if performance is None else idle_clip(performance, rig)
    camera = default_view() if performance is None else view_of(clip, performance)
    log.info("making its deformers")
    bundle = bundle_of(
        avatar_model(official, rig, grid, source=checkpoint),
        rig=rig,
        shape=official.shape,
        clip=performance or idle,
        idle=idle,
        camera=camera,
    )
    write_bundle(bundle, output)
    log.info("%s: %.1f MB", output, output.stat().st_size / 1e6)


def newest_checkpoint(model: Path) -> Path:
    """The `chkpntN.pth` of the most iterations in a folder; a file is taken as it is.

    Raises:
        DataError: There is none.
    """
    if model.is_file():
        return model
    try:
        found = [(int(m[1]), p) for p in model.iterdir() if (m := CHECKPOINT.fullmatch(p.name))]
    except OSError as error:
        expected = "a folder with chkpntN.pth"
        raise DataError(model, "folder", expected=expected, found=error.strerror) from error
    if not found:
        raise DataError(model, "folder", expected="a file chkpntN.pth", found="none")
    return max(found)[1]


def released_rig(flame: Path, assets: Path) -> HeadRig:
    """FLAME as the released code has it.

    Raises:
        DataError: It is not sound, or is another edition.
    """
    rig = import_flame(flame, assets)
    if rig.name != RELEASED_RIG:
        raise DataError(flame, "model", expected="FLAME 2023 without a jaw", found=rig.name)
    return rig


def read_official(path: Path, *, faces: int = N_FACES) -> OfficialAvatar:
    """Reads and checks a checkpoint.

    Args:
        faces: Triangles of the grid that its Gaussians are bound to.
    Raises:
        DataError: Naming the field, what was expected and what was found.
    """
    with TorchFile(path) as file:
        state, iteration = _pair(path, file.content)
        fields = _gaussian_fields(path, state["gaussians"])
        gaussians, binding = _gaussians(file, fields, faces)
        base_rot = _floats(file, "base_rot", state["base_rot"], (3,))
        if base_rot.any():
            log.warning("%s: base_rot is left aside: an avatar stands in the head's frame", path)
        return OfficialAvatar(
            iteration=iteration,
            shape=_floats(file, "shape", state["shape"], (N_IDENTITY,)),
            network=_network(file, state["deform_net"]),
            gaussians=gaussians,
            binding=binding,
        )


def avatar_model(official: OfficialAvatar, rig: HeadRig, grid: UvGrid, *, source: Path) -> AvatarModel:
    """The avatar as our fits have it.

    Raises:
        DataError: Its network has other layers than the released one (fact 22).
    """
    deformer = Deformer(grid.valid, width=official.width)
    _check_layers(source, official.network, deformer)
    deformer.load_state_dict({name: torch.from_numpy(value) for name, value in official.network.items()})
    gaussians = {name: torch.from_numpy(value) for name, value in official.gaussians.items()}
    subject = remesh(rig.subject(official.shape), grid)
    return AvatarModel(subject, grid, gaussians, torch.from_numpy(official.binding), deformer)


def default_view() -> Camera:
    """About the view that the released sample sequences are seen in, head-fixed world (fact 47)."""
    (cx, cy), size = DEFAULT_CENTRE, DEFAULT_SIZE
    K = np.array([[DEFAULT_FOCAL, 0, cx], [0, DEFAULT_FOCAL, cy], [0, 0, 1]])
    viewmat = head_fixed(np.eye(4), np.zeros(3), np.array([0, 0, -DEFAULT_DISTANCE]))
    return Camera(K, viewmat, size, size)


def read_clip(path: Path) -> Clip:
    """A FlowFace sequence of the released rig.

    Raises:
        DataError: It is not sound, or of another rig.
    """
    clip = read_sequence(path)
    if clip.rig_name != RELEASED_RIG:
        raise DataError(path, "rig_name", expected=repr(RELEASED_RIG), found=repr(clip.rig_name[:64]))
    if clip.expr.shape[1] != N_EXPRESSIONS:
        raise DataError(path, "expr", expected=f"[*, {N_EXPRESSIONS}]", found=list(clip.expr.shape))
    return clip


def view_of(path: Path, clip: Clip) -> Camera:
    """The clip's first camera as it stands to the head on average, or the default view without one."""
    if clip.rot is None or "extr" not in read_npz(path, names=("extr",)):
        return default_view()
    camera = read_cameras(path)[0]
    viewmat = head_fixed(camera.viewmat, np.median(clip.rot, 0), np.median(clip.tra, 0))
    return Camera(camera.K, viewmat, camera.width, camera.height)


def _summary(official: OfficialAvatar) -> str:
    degree = SH_COUNTS[1 + official.gaussians["sh_rest"].shape[1]]
    return (
        f"iteration {official.iteration}, {len(official.binding)} Gaussians of degree {degree}, "
        f"a U-Net {official.width} wide"
    )


def _pair(path: Path, content: Any) -> tuple[dict[str, Any], int]:
    """(dict, iteration)"""
    whole = isinstance(content, (tuple, list)) and len(content) == 2
    if not whole or not isinstance(content[0], dict) or type(content[1]) is not int:
        raise DataError(path, "checkpoint", expected="(dict, iteration)", found=_kind(content))
    state, iteration = content
    for key in KEYS:
        if key not in state:
            raise DataError(path, key, expected="an entry of the checkpoint", found="none")
    return state, iteration


def _gaussian_fields(path: Path, fields: Any) -> tuple[Any, ...]:
    if not isinstance(fields, (tuple, list)) or len(fields) != N_GAUSSIAN_FIELDS:
        expected = f"a tuple of {N_GAUSSIAN_FIELDS}"
        raise DataError(path, "gaussians", expected=expected, found=_kind(fields))
    return tuple(fields)


def _gaussians(
    file: TorchFile, fields: tuple[Any, ...], faces: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Raw local Gaussians and their binding."""
    degree, xyz, dc, rest, scaling, rotation, opacity, binding, counter = fields[:9]
    means = _floats(file, "_xyz", xyz, (None, 3))
    n = len(means)
    low, high = COUNTS["gaussians"]
    if not low <= n <= high:
        raise DataError(file.path, "_xyz", expected=f"{low} to {high} Gaussians", found=n)
    gaussians = {
        "means": means,
        "quats": _floats(file, "_rotation", rotation, (n, 4)),
        "log_scales": _floats(file, "_scaling", scaling, (n, 3)),
        "opacity_logits": _floats(file, "_opacity", opacity, (n, 1))[:, 0].copy(),
        "sh_dc": _floats(file, "_features_dc", dc, (n, 1, 3)),
        "sh_rest": _harmonics(file, rest, degree, n),
    }
    check_gaussians(file.path, {field: (name, gaussians[key]) for field, (name, key) in CHECKED.items()})
    bound = _indices(file, "binding", binding, (n,), below=faces)
    counts = _indices(file, "binding_counter", counter, (faces,), below=n + 1)
    if not np.array_equal(counts, np.bincount(bound, minlength=faces)):
        log.warning("%s: binding_counter does not count binding: binding is taken", file.path)
    return gaussians, bound


def _harmonics(file: TorchFile, rest: Any, degree: Any, n: int) -> np.ndarray:
    """float32[N, (degree + 1)^2 - 1, 3]"""
    values = _floats(file, "_features_rest", rest, (n, None, 3))
    count = 1 + values.shape[1]
    if count not in SH_COUNTS:
        expected = "harmonics of a degree up to 3"
        raise DataError(file.path, "_features_rest", expected=expected, found=list(values.shape))
    if type(degree) is not int or not 0 <= degree <= SH_COUNTS[count]:
        expected, found = f"0 to {SH_COUNTS[count]}", degree if _is_short(degree) else _kind(degree)
        raise DataError(file.path, "active_sh_degree", expected=expected, found=found)
    return np.ascontiguousarray(values[:, : (degree + 1) ** 2 - 1])


def _network(file: TorchFile, state: Any) -> dict[str, np.ndarray]:
    """The state dict; its first layer has a width that makes sense, the others are `_check_layers`'."""
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise DataError(file.path, "deform_net", expected="a state dict", found=_kind(state))
    first = "model.model.0.weight"
    shape = getattr(state.get(first), "shape", ())
    if len(shape) != 4 or not 1 <= shape[0] <= MAX_WIDTH or shape[1:] != (3 + ENCODING_CHANNELS, 4, 4):
        expected, found = f"[1 to {MAX_WIDTH}, {3 + ENCODING_CHANNELS}, 4, 4]", list(shape) or "nothing"
        raise DataError(file.path, f"deform_net {first}", expected=expected, found=found)
    size = sum(value.count for value in state.values() if isinstance(value, TensorRecord))
    if size > MAX_NETWORK_VALUES:  # many tensors may be of one storage
        expected = f"at most {MAX_NETWORK_VALUES} numbers"
        raise DataError(file.path, "deform_net", expected=expected, found=size)
    return {
        name: _floats(file, f"deform_net {name[:80]}", value, (None,) * len(getattr(value, "shape", (0,))))
        for name, value in state.items()
    }


def _check_layers(path: Path, network: dict[str, np.ndarray], deformer: Deformer) -> None:
    layers = {name: tuple(value.shape) for name, value in deformer.named_parameters()}
    for name, shape in layers.items():
        found = list(network[name].shape) if name in network else "nothing"
        if found != list(shape):
            raise DataError(path, f"deform_net {name}", expected=list(shape), found=found)
    unknown = sorted(network.keys() - layers.keys())
    if unknown:
        expected = f"{len(layers)} tensors"
        raise DataError(path, "deform_net", expected=expected, found=f"also {unknown[0][:80]}")


def _floats(file: TorchFile, field: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    _check_shape(file.path, field, value, shape)
    return checked_float32(file.path, field, file.array(field, value), shape=shape)


def _indices(
    file: TorchFile, field: str, value: Any, shape: tuple[int | None, ...], *, below: int
) -> np.ndarray:
    _check_shape(file.path, field, value, shape)
    return checked_indices(file.path, field, file.array(field, value), shape=shape, below=below)


def _check_shape(path: Path, field: str, value: Any, shape: tuple[int | None, ...]) -> None:
    """Before any of it is read."""
    if not isinstance(value, TensorRecord):
        return  # NumPy's own is in memory; anything else is refused where it is read
    fits = len(value.shape) == len(shape)
    if not fits or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True)):
        expected = f"[{', '.join('*' if n is None else str(n) for n in shape)}]"
        raise DataError(path, field, expected=expected, found=list(value.shape))


def _is_short(value: Any) -> bool:
    """Whether it is a number that can be shown. What holds itself many times over takes for ever to print."""
    return type(value) is int and abs(value) < 1 << 32


def _kind(value: Any) -> str:
    size = f" of {len(value)}" if isinstance(value, (tuple, list, dict)) else ""
    return f"{type(value).__name__}{size}"
