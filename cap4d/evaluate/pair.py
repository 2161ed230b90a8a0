"""What a metric looks at: a picture of the avatar beside the truth of the same view."""

from __future__ import annotations

from collections.abc import Hashable
from functools import cached_property

import numpy as np

from cap4d.errors import ArgumentError
from cap4d.evaluate.faces import AvertedFinder, FaceFinder, Faces

MIN_SIDE = 16  # px; SSIM's window has 11, LPIPS halves its image four times


class Pair:
    """A picture and its truth; faces are looked for when a metric asks for them, once.

    Args:
        image, truth: float32[H, W, 3] sRGB in [0, 1], both on the same background.
        coverage: float32[H, W] the person's matte, or None.
        finder: What finds faces; None: metrics that need faces cannot be asked.
        truth_key: What the truth is known by, for the finder to look at it once only; see `FaceFinder.find`.
    Raises:
        ArgumentError: The two are not finite images in [0, 1] of one size of at least 16 px a side.
    """

    def __init__(
        self,
        image: np.ndarray,
        truth: np.ndarray,
        *,
        coverage: np.ndarray | None = None,
        finder: FaceFinder | AvertedFinder | None = None,
        truth_key: Hashable = None,
    ) -> None:
        self.image, self.truth = _checked("image", image), _checked("truth", truth)
        if self.image.shape != self.truth.shape:
            expected, found = list(self.truth.shape), list(self.image.shape)
            raise ArgumentError(f"image: expected {expected} as the truth, got {found}")
        if coverage is not None and coverage.shape != self.truth.shape[:2]:
            expected, found = list(self.truth.shape[:2]), list(coverage.shape)
            raise ArgumentError(f"coverage: expected {expected} as the truth, got {found}")
        self.coverage, self._finder, self._truth_key = coverage, finder, truth_key

    @cached_property
    def faces(self) -> Faces:
        """The face in both images."""
        if self._finder is None:
            raise ArgumentError("faces: expected a pair with a face finder, got one without")
        image = self._finder.find(self.image)
        truth = self._finder.find(self.truth, key=self._truth_key)
        return Faces(image, truth, self.truth.shape[:2])


def _checked(name: str, image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < MIN_SIDE:
        side = f"[H >= {MIN_SIDE}, W >= {MIN_SIDE}, 3]"
        raise ArgumentError(f"{name}: expected float{side}, got {image.dtype}{list(image.shape)}")
    if image.dtype.kind != "f" or not (image.min() >= 0 and image.max() <= 1):  # NaN is neither
        raise ArgumentError(f"{name}: expected floats in [0, 1], got {image.dtype} or numbers beyond")
    return image.astype(np.float32, copy=False)
