"""What the training views would lose with each single Gaussian: the measure by which needless ones go.

As in cap4d.optimize.removal, but through the differentiable rasteriser, so that it runs where the fit runs.
A pixel is linear in each opacity, so without Gaussian i it changes by exactly o_i dI/do_i, whatever lies
behind; the sum of its square over pixels is, up to noise, what a vector-Jacobian product with random signs
gives (Hutchinson 1990).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from cap4d.avatar.model import Posed
from cap4d.avatar.views import FitView
from cap4d.raster import rasterize

HIGHEST = 0.98  # opacities stay below the clamp at 0.99, above which the gradient is 0


def removal_errors(
    pose: Callable[[FitView], Posed], views: Sequence[FitView], *, sh_degree: int, generator: torch.Generator
) -> torch.Tensor:
    """[N] the mean squared error that each Gaussian's removal alone would make in the views.

    0 for what no view shows.

    Args:
        pose: The avatar in a view.
        views: At least one.
        sh_degree: Harmonics up to this degree.
        generator: Of the signs.
    """
    total, values = None, 0
    for view in views:
        with torch.no_grad():
            p = pose(view)
        opacities = p.opacities.clamp(max=HIGHEST).requires_grad_()
        drawn = rasterize(
            *(p.means, p.quats, p.scales, opacities, p.sh),
            camera=view.camera,
            background=(1.0, 1.0, 1.0),
            sh_degree=sh_degree,
        )
        signs = (2 * torch.randint(0, 2, drawn.rgb.shape, generator=generator) - 1).to(drawn.rgb)
        gradient = torch.autograd.grad(drawn.rgb, opacities, signs)[0]
        errors = (gradient * opacities.detach()).square()
        total = errors if total is None else total + errors
        values += signs.numel()
    return total / values
