"""The avatar while it is fitted: a head on the UV grid, a network that moves it, Gaussians on its triangles.

Everything is in the head-fixed frame, OpenCV axes, metres; the head's pose is in the cameras (fact 31).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import nn

from cap4d.avatar.bound import bind_to
from cap4d.avatar.deformer import Deformer
from cap4d.camera import opencv_from_rig
from cap4d.drive.clip import Frame
from cap4d.rig.grid import UvGrid, remesh
from cap4d.rig.head import HeadRig, Subject

INITIAL_REACH = 0.4  # face sizes; initial local means are uniform in [0, 0.4)^3 (fact 29)
INITIAL_OPACITY = 0.1
GAUSSIAN_FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest")


@dataclass(frozen=True, eq=False)
class Pose:
    """What drives the avatar at one moment: expr [E]; eye_rot, neck_rot, jaw_rot [3] rad; all torch."""

    expr: torch.Tensor
    eye_rot: torch.Tensor
    neck_rot: torch.Tensor
    jaw_rot: torch.Tensor

    @staticmethod
    def of(frame: Frame) -> Pose:
        """A frame of a clip as tensors."""
        return Pose(*(torch.from_numpy(getattr(frame, f.name).astype(np.float32)) for f in fields(Pose)))


@dataclass(frozen=True, eq=False)
class Deformation:
    """What the network answers.

    Args:
        maps: [2, 3, S, S] m, of the real and of the zero offsets, as they leave the network.
        moved, neutral: [G, 3] m, with the expression and without; equal off the deformable mask (fact 24).
    """

    maps: torch.Tensor
    moved: torch.Tensor
    neutral: torch.Tensor


@dataclass(frozen=True, eq=False)
class Posed:
    """The avatar at one moment, in the head-fixed frame.

    Args:
        surface: [G, 3] m, the rig alone, before any rigid correction.
        deformation: What the network adds to it; None without a network.
        means, quats, scales: [N, ...] Gaussians, m.
        opacities: [N].
        sh: [N, S, 3].
    """

    surface: torch.Tensor
    deformation: Deformation | None
    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor


class AvatarModel(nn.Module):
    """A person's avatar on any rig (facts 20-32).

    Args:
        subject: The shape-baked rig on the G grid vertices, NumPy.
        grid: The rig's UV grid.
        gaussians: Local Gaussians, raw: the tensors of `GAUSSIAN_FIELDS`, N rows each.
        binding: int32[N] the triangle each sits on.
        deformer: None: nothing but the rig moves the surface.
    """

    def __init__(
        self,
        subject: Subject,
        grid: UvGrid,
        gaussians: dict[str, torch.Tensor],
        binding: torch.Tensor,
        deformer: Deformer | None,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.subject = subject.map(lambda array: torch.from_numpy(np.ascontiguousarray(array, np.float32)))
        self.deformer = deformer
        self.gaussians = nn.ParameterDict({name: nn.Parameter(gaussians[name]) for name in GAUSSIAN_FIELDS})
        self.register_buffer("binding", binding)
        self.register_buffer("faces", torch.from_numpy(grid.faces), persistent=False)
        self.register_buffer("deformable", torch.from_numpy(grid.deformable)[:, None], persistent=False)

    def _apply(
        self, function: Callable[[torch.Tensor], torch.Tensor], *args: Any, **options: Any
    ) -> AvatarModel:
        self.subject = self.subject.map(function)  # not a module, but goes where the module goes
        return super()._apply(function, *args, **options)

    def __len__(self) -> int:
        """Gaussians."""
        return len(self.binding)

    def offsets(self, pose: Pose) -> torch.Tensor:
        """[3, S, S] m: what expression and eyes move, jaw in both terms, neck in none (fact 20)."""
        with torch.no_grad():
            posed = self.subject.pose(pose.expr, eye_rot=pose.eye_rot, jaw_rot=pose.jaw_rot)
            neutral = self.subject.pose(torch.zeros_like(pose.expr), jaw_rot=pose.jaw_rot)
            return self.grid.to_map(opencv_from_rig(posed - neutral))

    def deform(self, offsets: torch.Tensor) -> Deformation:
        """Both passes of the network as one batch (fact 24). The model must have a network."""
        maps = self.deformer(torch.stack([offsets, torch.zeros_like(offsets)]))
        moved, neutral = self.grid.from_map(maps)
        return Deformation(maps, torch.where(self.deformable, moved, neutral), neutral)

    def surface(self, pose: Pose) -> torch.Tensor:
        """[G, 3] m: the rig alone, head-fixed frame."""
        p = pose
        posed = self.subject.pose(p.expr, eye_rot=p.eye_rot, neck_rot=p.neck_rot, jaw_rot=p.jaw_rot)
        return opencv_from_rig(posed)

    def pose(
        self,
        pose: Pose,
        *,
        rigid: tuple[torch.Tensor, torch.Tensor] | None = None,
        network_pose: Pose | None = None,
    ) -> Posed:
        """The Gaussians for a pose.

        Args:
            rigid: Rotation [3, 3] and translation [3] applied to the whole head, to correct a tracked head
                pose.
            network_pose: What the network sees, if not `pose`.
        """
        surface = self.surface(pose)
        deformation = None if self.deformer is None else self.deform(self.offsets(network_pose or pose))
        vertices = surface if deformation is None else surface + deformation.moved
        if rigid is not None:
            vertices = vertices @ rigid[0].T + rigid[1]
        local = self.gaussians
        means, quats, scales = self.riding(vertices)
        return Posed(
            surface,
            deformation,
            means,
            quats,
            scales,
            local["opacity_logits"].sigmoid(),
            torch.cat([local["sh_dc"], local["sh_rest"]], 1),
        )

    def riding(self, vertices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """means [N, 3] m, quats [N, 4], scales [N, 3] m of the Gaussians on [G, 3] m vertices (fact 27)."""
        local = {name: self.gaussians[name] for name in ("means", "quats", "log_scales")}
        return bind_to(vertices, self.faces, **local, binding=self.binding)

    def moving_map(self, deformation: Deformation) -> torch.Tensor:
        """[3, S, S] m: the map of the expression where the surface may move, elsewhere the neutral one."""
        moved, neutral = deformation.maps
        return torch.where(self.grid.to_map(self.deformable)[0], moved, neutral)

    def neutral_deformation(self) -> torch.Tensor:
        """[G, 3] m: the network's answer to no offsets, a constant of the avatar (fact 24)."""
        size = self.grid.size
        if self.deformer is None:
            return torch.zeros(len(self.grid), 3)
        with torch.no_grad():
            return self.grid.from_map(self.deformer(torch.zeros(1, 3, size, size)))[0]


def initial_counts(rig: HeadRig, grid: UvGrid, *, gaussians: int, per_face: int) -> np.ndarray:
    """int64[M] Gaussians per triangle: by area on the template, at least `per_face` (fact 29).

    On the rig's own triangles those few that each has anyway are part of the budget: a rig may have more of
    them than a UV grid, and would otherwise begin with more Gaussians. Without a floor the triangles that get
    none are spread evenly over the others.
    """
    corners = remesh(rig, grid).template.astype(np.float64)[grid.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    shares = areas / areas.sum()
    if per_face == 0:
        return np.diff(np.floor(np.cumsum(gaussians * shares) + 0.5), prepend=0).astype(np.int64)
    counts = _counts(shares, gaussians, per_face)
    if not grid.is_mesh or counts.sum() <= gaussians:
        return counts
    low, high = 0.0, float(gaussians)
    while high - low > 1:
        middle = (low + high) / 2
        within = _counts(shares, middle, per_face).sum() <= gaussians
        low, high = (middle, high) if within else (low, middle)
    return _counts(shares, low, per_face)


def _counts(shares: np.ndarray, gaussians: float, per_face: int) -> np.ndarray:
    return np.maximum(per_face, np.round(gaussians * shares)).astype(np.int64)


def initial_gaussians(
    counts: np.ndarray, *, sh_degree: int, generator: torch.Generator
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Fact 29: means in [0, 0.4)^3, scale 1 / count of the face, opacity 0.1, grey.

    Where there are fewer Gaussians than faces they are larger, so that they cover those that have none.
    Returns:
        The raw local Gaussians and their binding int32[N], in the order of the faces.
    """
    binding = torch.repeat_interleave(torch.arange(len(counts)), torch.from_numpy(counts))
    n = len(binding)
    scale = 1 / torch.from_numpy(counts)[binding].float()
    if (counts == 0).any():
        scale *= max(1.0, (len(counts) / n) ** 0.5)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    gaussians = {
        "means": torch.rand(n, 3, generator=generator) * INITIAL_REACH,
        "quats": quats,
        "log_scales": scale.log()[:, None].repeat(1, 3),
        "opacity_logits": torch.full((n,), INITIAL_OPACITY).logit(),
        "sh_dc": torch.rand(n, 1, 3, generator=generator) / 255,
        "sh_rest": torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3),
    }
    return gaussians, binding.int()


def create_avatar(
    rig: HeadRig,
    shape: np.ndarray,
    *,
    grid: UvGrid,
    gaussians: int,
    per_face: int,
    sh_degree: int,
    deformer_width: int | None,
    generator: torch.Generator,
) -> AvatarModel:
    """An avatar before its first step.

    Args:
        shape: [S] the person's identity.
        gaussians, per_face: See `Preset`.
        deformer_width: None leaves the network out.
        generator: All randomness comes from it.
    """
    counts = initial_counts(rig, grid, gaussians=gaussians, per_face=per_face)
    local, binding = initial_gaussians(counts, sh_degree=sh_degree, generator=generator)
    deformer = None
    if deformer_width is not None:
        deformer = Deformer(grid.valid, width=deformer_width, generator=generator)
    subject = remesh(rig.subject(np.asarray(shape, np.float32)), grid)
    return AvatarModel(subject, grid, local, binding, deformer)
