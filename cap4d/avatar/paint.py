"""First colours for the Gaussians, seen in the images through the surface: a start for short fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from cap4d.avatar.model import AvatarModel, Pose
from cap4d.avatar.views import FitView
from cap4d.mesh import rasterize_mesh

SH_C0 = 0.28209479177387814  # of the constant harmonic, 1 / (2 sqrt(pi))
MIN_COVERAGE = 0.9  # pixels that the matte gives to the background for more than a tenth are not looked at


def paint(model: AvatarModel, views: Sequence[FitView], poses: Sequence[Pose]) -> None:
    """Sets the DC colour of every Gaussian to what the views show of its triangle.

    Triangles that no view sees take the colour of the nearest one that is seen.
    Args:
        views, poses: A handful of images and what drives the avatar in them.
    """
    faces = model.grid.faces
    total, pixels = np.zeros((len(faces), 3)), np.zeros(len(faces))
    for view, pose in zip(views, poses, strict=True):
        vertices = model.surface(pose).numpy()
        seen = rasterize_mesh(vertices, faces, view.camera).face
        hit = seen >= 0
        if view.coverage is not None:
            hit &= view.coverage.float().numpy() > MIN_COVERAGE
        np.add.at(total, seen[hit], view.target.numpy()[hit])
        np.add.at(pixels, seen[hit], 1)
    if not pixels.any():
        return
    colours = total / np.maximum(pixels, 1)[:, None]
    centres = vertices[faces].mean(1)
    known = pixels > 0
    nearest = cKDTree(centres[known]).query(centres[~known])[1]
    colours[~known] = colours[known][nearest]
    dc = torch.from_numpy((colours - 0.5) / SH_C0).float()
    model.gaussians["sh_dc"].data = dc[model.binding][:, None].clone()
