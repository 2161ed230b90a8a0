"""A candidate as the steps that learn see it: Gaussians in torch, its own moving surface, the pictures to
match.

The surface of every shot is posed once, with the deformer and the rounding that the file will have, so that
what is learned makes up for both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cap4d.avatar.bound import bind_to
from cap4d.bundle.bundle import Bundle
from cap4d.optimize.measure import pose
from cap4d.optimize.oracle import Picture
from cap4d.optimize.shots import Shot
from cap4d.player.avatar import Avatar
from cap4d.render import render

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True, eq=False)
class Scene:
    """What does not change while Gaussians do.

    Args:
        shots: To look at.
        truth: The full avatar's pictures of them, float32.
        surfaces: The candidate's vertices in each, float32[G, 3] m.
        faces: int32[M, 3].
    """

    shots: tuple[Shot, ...]
    truth: tuple[Picture, ...]
    surfaces: tuple[Tensor, ...]
    faces: Tensor

    def __len__(self) -> int:
        return len(self.shots)

    def pose(self, index: int, local: dict[str, Tensor], binding: Tensor) -> tuple[Tensor, ...]:
        """means, quats, scales, opacities, sh of a shot, with gradients to `local`."""
        raw = {name: local[name] for name in FIELDS[:3]}
        posed = bind_to(self.surfaces[index], self.faces, **raw, binding=binding)
        return *posed, local["opacity_logits"].sigmoid(), local["sh"]


def full_pictures(avatar: Avatar, shots: Sequence[Shot]) -> tuple[Picture, ...]:
    """What the steps that learn aim at: the player's own pictures, float32."""
    drawn = (render(pose(avatar, s), s.camera, background=None, threads=avatar.threads) for s in shots)
    return tuple(Picture(d.rgb, d.alpha) for d in drawn)


def make_scene(avatar: Avatar, shots: Sequence[Shot], truth: Sequence[Picture]) -> Scene:
    """The scene of a candidate's player."""
    surfaces = []
    for shot in shots:
        f = shot.frame
        vertices = avatar.vertices(f.expr, eye_rot=f.eye_rot, neck_rot=f.neck_rot, jaw_rot=f.jaw_rot)
        surfaces.append(torch.from_numpy(np.array(vertices, np.float32)))
    return Scene(tuple(shots), tuple(truth), tuple(surfaces), torch.from_numpy(avatar.bundle.grid.faces))


def tensors(bundle: Bundle) -> tuple[dict[str, Tensor], Tensor]:
    """The Gaussians, raw and local, and their binding."""
    local = {name: torch.from_numpy(getattr(bundle, name).copy()) for name in FIELDS}
    return local, torch.from_numpy(bundle.binding.copy())
