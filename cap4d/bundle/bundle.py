"""A fitted avatar as a player needs it, in memory. Files: reader.py, writer.py, FORMAT.md."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cap4d.bundle.onnx_scan import stores_half
from cap4d.camera import Camera
from cap4d.drive.clip import Clip
from cap4d.rig.grid import UvGrid
from cap4d.rig.head import Subject


@dataclass(frozen=True, eq=False)
class Bundle:
    """G grid vertices, M faces, N Gaussians, E expressions, S pixels a side of the grid.

    Args:
        rig_licence: SPDX-like tag of what the rig was made from.
        expression_range: float32[E, 2] useful values.
        grid: The rig's UV grid, or its own triangles, which have no deformer.
        subject: The head on the G grid vertices, rig axes; float32.
        deform_neutral: float32[G, 3] m, head frame, OpenCV axes: the network's answer to no offsets.
        deform_onnx: Network `offsets` float32[1, 3, S, S] m -> `deformation`, the same, with scaling, masks
            and positional encoding inside (facts 20-23); None: there is none, see the next two.
        means, quats, log_scales, opacity_logits, sh: float32 [N, 3], [N, 4], [N, 3], [N] and
            [N, (degree + 1)^2, 3]: raw Gaussians in the local frames of their triangles (facts 26, 27).
        binding: int32[N] into `grid.faces`.
        camera: Default view of the head-fixed world.
        idle: What plays when nothing drives the avatar.
        preview: PNG.
        mesh_subject: The head on all V vertices of the rig, if known: `subject` is then exactly its mixture
            by `grid.vertices` and `grid.bary`, and a file stores whichever is smaller.
        deform_int8: The network in whole numbers, as `quantized_unet.py` names its tensors; or None.
        deform_linear: float32[E, G, 3] m per unit of expression, rig axes, 0 where the grid is not
            deformable: added to `subject.expression_basis` it stands in for the network; or None.
        tier_errors: How far each of a deformer's tiers is from `full`: name -> (RMS, largest), mm.
        rig_vertices: V; filled in from `mesh_subject`, or else the least that `grid.vertices` allows.
    """

    rig_licence: str
    expression_range: np.ndarray
    grid: UvGrid
    subject: Subject
    deform_neutral: np.ndarray
    deform_onnx: bytes | None
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    binding: np.ndarray
    camera: Camera
    idle: Clip
    preview: bytes
    mesh_subject: Subject | None = None
    deform_int8: dict[str, np.ndarray] | None = None
    deform_linear: np.ndarray | None = None
    tier_errors: dict[str, tuple[float, float]] = field(default_factory=dict)
    rig_vertices: int = 0

    def __post_init__(self) -> None:
        if self.mesh_subject is not None:
            object.__setattr__(self, "rig_vertices", len(self.mesh_subject.neutral))
        elif not self.rig_vertices:
            object.__setattr__(self, "rig_vertices", int(self.grid.vertices.max()) + 1)

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def rig_name(self) -> str:
        return self.subject.rig_name

    @property
    def tiers(self) -> tuple[str, ...]:
        """The forms of the deformer that it can play, the most exact first: of `full` and `fp16` (float32
        arithmetic on weights stored as float16) the one its network is, then `int8`, `linear`, `off`.
        """
        tiers = []
        if self.deform_onnx is not None:
            tiers.append("fp16" if stores_half(self.deform_onnx) else "full")
        cheaper = {"int8": self.deform_int8, "linear": self.deform_linear}
        return (*tiers, *(tier for tier, part in cheaper.items() if part is not None), "off")

    @property
    def n_expressions(self) -> int:
        return len(self.subject.expression_names)
