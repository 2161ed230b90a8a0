"""The face of a picture and the face of the truth, as MediaPipe's 478 landmarks see them."""

from __future__ import annotations

from collections.abc import Hashable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cap4d.camera import OPENCV_FROM_RIG, Camera
from cap4d.errors import ArgumentError

NORMAL_SIDE = 512  # px of the larger side: the image that distances are said for
MAX_ASIDE_DEG = 75.0  # from straight before the face: farther aside one of the eyes is hidden


@dataclass(frozen=True, eq=False)
class Faces:
    """Landmarks of a pair of images of `size` (height, width): float64[478, 2] px, None where no face is."""

    image: np.ndarray | None
    truth: np.ndarray | None
    size: tuple[int, int]

    @property
    def both(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Those of image and truth, or None unless both were found."""
        if self.image is None or self.truth is None:
            return None
        return self.image, self.truth

    @property
    def scale(self) -> float:
        """From px to px of an image whose larger side has 512."""
        return NORMAL_SIDE / max(self.size)


class FaceFinder:
    """MediaPipe, started with the first image. Use as a context manager.

    Every image is looked at afresh, so that neither order nor neighbours change what is found. One finder can
    serve several evaluations on a capture: it remembers the truths' faces.
    """

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._known: dict[Hashable, np.ndarray | None] = {}

    def __enter__(self) -> FaceFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def find(self, image: np.ndarray, *, key: Hashable = None) -> np.ndarray | None:
        """Landmarks float64[478, 2] px (pixel centres at .5) in float[H, W, 3] in [0, 1], or None.

        Args:
            key: What the image is known by, to be looked at once only; None: look.
        """
        if key is None:
            return self._look(image)
        if key not in self._known:
            self._known[key] = self._look(image)
        return self._known[key]

    def _look(self, image: np.ndarray) -> np.ndarray | None:
        return self._detector.landmarks(np.rint(image * 255).astype(np.uint8))

    @cached_property
    def _detector(self):
        from cap4d.track.landmarks import Detector, without_native_chatter

        self._stack.enter_context(without_native_chatter())  # to the end: the first face makes it talk, too
        return self._stack.enter_context(Detector(video=False))


class AvertedFinder:
    """For views of a head from behind, in which MediaPipe now and then sees a face that is not there."""

    def find(self, image: np.ndarray, *, key: Hashable = None) -> None:
        """None."""


def faces_camera(camera: Camera) -> bool:
    """Whether a camera of the head-fixed world stands where it sees both eyes of the head."""
    away = camera.position
    forward = OPENCV_FROM_RIG @ [0.0, 0.0, 1.0]
    return bool(forward @ away >= np.cos(np.radians(MAX_ASIDE_DEG)) * np.linalg.norm(away))


def mediapipe_missing() -> str | None:
    """How to get MediaPipe where it is not installed; None where it is."""
    try:
        from cap4d.track.landmarks import import_mediapipe

        import_mediapipe()
    except ModuleNotFoundError as error:
        return f"the package {error.name} (pip install 'cap4d[track]')"
    except ArgumentError:
        return "MediaPipe (pip install --no-deps mediapipe==0.10.21, Python 3.9 to 3.12)"
    return None
