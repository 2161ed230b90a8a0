"""Takes out what no picture needs, exactly: an avatar without it gives the same pictures, to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.optimize.candidate import with_gaussians, with_subject
from cap4d.raster.reference import ALPHA_MIN
from cap4d.rig.head import Subject


def without_unused(bundle: Bundle) -> Bundle:
    """The bundle without Gaussians too faint to be drawn, faces that carry none, correctives that correct
    nothing and the constant offset, which becomes part of the neutral head.
    """
    opacities = 1 / (1 + np.exp(-bundle.opacity_logits.astype(np.float64)))
    drawn = opacities >= ALPHA_MIN
    if drawn.any() and not drawn.all():
        bundle = with_gaussians(bundle, drawn)
    return without_bare_faces(with_subject(bundle, _plain))


def without_bare_faces(bundle: Bundle) -> Bundle:
    """The bundle without the faces of the grid that carry no Gaussian."""
    used, binding = np.unique(bundle.binding, return_inverse=True)
    if len(used) == len(bundle.grid.faces):
        return bundle
    grid = replace(bundle.grid, faces=np.ascontiguousarray(bundle.grid.faces[used]))
    return replace(bundle, grid=grid, binding=binding.astype(np.int32))


def _plain(subject: Subject) -> Subject:
    if subject.pose_offset is not None:
        moved = (subject.neutral + subject.pose_offset).astype(np.float32)
        subject = replace(subject, neutral=moved, pose_offset=None)
    if subject.pose_basis is not None and not subject.pose_basis.any():
        subject = replace(subject, pose_basis=None)
    if subject.expr_rotation is not None and not subject.expr_rotation.any():
        subject = replace(subject, expr_rotation=None)
    return subject
