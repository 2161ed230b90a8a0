"""3D Gaussians as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cap4d.errors import ArgumentError

SH_COUNTS = {1: 0, 4: 1, 9: 2, 16: 3}  # coefficients per channel -> degree


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N activated Gaussians in one frame of reference (the head-fixed frame, OpenCV axes, metres).

    Args:
        means: float32[N, 3] m.
        quats: float32[N, 4] wxyz; need not be unit.
        scales: float32[N, 3] standard deviations, m.
        opacities: float32[N] in [0, 1].
        sh: float32[N, S, 3] spherical harmonics, S = (degree + 1)^2, DC first;
            colour = 0.5 + sum, clamped at 0.
    Raises:
        ArgumentError: A field has the wrong shape or dtype.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.means)
        shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.dtype != np.float32 or value.shape != shape:
                raise ArgumentError(
                    f"{name}: expected float32{list(shape)}, got {value.dtype}{list(value.shape)}"
                )
        sh = self.sh
        if (
            sh.dtype != np.float32
            or sh.ndim != 3
            or sh.shape[0] != n
            or sh.shape[1] not in SH_COUNTS
            or sh.shape[2] != 3
        ):
            raise ArgumentError(f"sh: expected float32[{n}, 1|4|9|16, 3], got {sh.dtype}{list(sh.shape)}")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return SH_COUNTS[self.sh.shape[1]]
