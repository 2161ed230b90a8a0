"""Spherical harmonics of a lower degree, fitted to what the dropped coefficients showed where it was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from cap4d.bundle.bundle import Bundle
from cap4d.harmonics import sh_basis
from cap4d.optimize.removal import blending_weights
from cap4d.optimize.scene import Scene, tensors
from cap4d.raster.threads import one_torch_thread

RIDGE = 0.05
"""Pull towards the coefficients that are kept, as a share of a seen direction's weight: what was seen from
one side only keeps its colour from the others."""


@one_torch_thread()
def at_degree(bundle: Bundle, scene: Scene, degree: int) -> Bundle:
    """The bundle with spherical harmonics up to `degree`.

    For each Gaussian the kept coefficients c' minimise Sum_k w_k (Y(d_k) c - Y'(d_k) c')^2 over the shots k,
    w_k its share in the pixels and d_k its direction, and a ridge towards c (the clamp of colours at 0
    aside).
    """
    weights = blending_weights(bundle, scene).astype(np.float64)
    weights /= np.maximum(weights.sum(0), 1e-12)
    size, full = (degree + 1) ** 2, bundle.sh.shape[1]
    squares = np.tile(RIDGE * np.eye(size), (len(bundle), 1, 1))
    products = np.zeros((len(bundle), size, 3))
    dropped = bundle.sh[:, size:].astype(np.float64)
    local, binding = tensors(bundle)
    for index in range(len(scene)):
        position = torch.from_numpy(scene.shots[index].camera.position)
        directions = scene.pose(index, local, binding)[0].double() - position
        basis = sh_basis(directions / directions.norm(dim=1, keepdim=True), int(full**0.5) - 1).numpy()
        kept, rest = basis[:, :size], basis[:, size:]
        weighted = weights[index][:, None] * kept
        squares += weighted[:, :, None] * kept[:, None]
        products += weighted[:, :, None] * np.einsum("nc,nck->nk", rest, dropped)[:, None]
    changed = bundle.sh[:, :size] + np.linalg.solve(squares, products)
    return replace(bundle, sh=np.ascontiguousarray(changed, np.float32))
