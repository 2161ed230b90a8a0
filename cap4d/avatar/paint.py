"""First colours for the Gaussians, seen in the images through the surface: a start for short fits.

It also settles what no image will: triangles that no view sees would stay faint and grey, and a camera that
moves around the head would look through them. They begin as opaque flakes coloured as the nearest seen ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from cap4d.avatar.model import AvatarModel, Pose
from cap4d.avatar.views import FitView
from cap4d.mesh import rasterize_mesh

SH_C0 = 0.28209479177387814  # of the constant harmonic, 1 / (2 sqrt(pi))
MIN_COVERAGE = 0.9  # of the person in a pixel's matte, to be looked at
FINER = 3  # the mesh is drawn this many times larger: eyelids have triangles smaller than a pixel
NEIGHBOURS = 12
FLAKE = (0.7, 0.15, 0.7)  # local scales; the second axis is the triangle's normal (fact 27)
FLAKE_OPACITY = 0.9


def paint(model: AvatarModel, views: Sequence[FitView], poses: Sequence[Pose]) -> None:
    """Sets the DC colour of all Gaussians, and shape and opacity of those on triangles that no view sees.

    Args:
        views, poses: Some images and what drives the avatar in them.
    """
    total, pixels = np.zeros((len(model.faces), 3)), np.zeros(len(model.faces))
    for view, pose in zip(views, poses, strict=True):
        _look(model, view, pose, total, pixels)
    seen = pixels > 0
    if not seen.any():
        return
    colours = total / np.maximum(pixels, 1)[:, None]
    centres = model.subject.neutral.numpy()[model.grid.faces].mean(1)
    k = min(NEIGHBOURS, int(seen.sum()))
    near = cKDTree(centres[seen]).query(centres[~seen], k=k)[1].reshape(-1, k)
    colours[~seen] = np.median(colours[seen][near], 1)
    binding = model.binding.long()
    model.gaussians["sh_dc"].data = torch.from_numpy((colours - 0.5) / SH_C0).float()[binding][:, None]
    _make_flakes(model, torch.from_numpy(~seen)[binding])


def _look(model: AvatarModel, view: FitView, pose: Pose, total: np.ndarray, pixels: np.ndarray) -> None:
    """Adds what one view sees of each triangle to `total` [M, 3] and `pixels` [M]."""
    camera = view.camera.resized(FINER * view.camera.width, FINER * view.camera.height)
    face = rasterize_mesh(model.surface(pose).numpy(), model.grid.faces, camera).face
    image = view.target.numpy().repeat(FINER, 0).repeat(FINER, 1)
    hit = face >= 0
    if view.coverage is not None:
        hit &= view.coverage.float().numpy().repeat(FINER, 0).repeat(FINER, 1) > MIN_COVERAGE
    np.add.at(total, face[hit], image[hit])
    np.add.at(pixels, face[hit], 1)


def _make_flakes(model: AvatarModel, rows: torch.Tensor) -> None:
    """Lays Gaussians bool[N] flat and opaque on their triangles, together about as large as those."""
    local = {name: value.data for name, value in model.gaussians.items()}
    binding = model.binding.long()
    crowd = torch.bincount(binding, minlength=len(model.faces))[binding][rows].float()
    local["means"][rows] *= torch.tensor([1.0, 0.0, 1.0])
    local["log_scales"][rows] = torch.tensor(FLAKE).log() - 0.5 * crowd.log()[:, None]
    local["opacity_logits"][rows] = torch.logit(torch.tensor(FLAKE_OPACITY))
