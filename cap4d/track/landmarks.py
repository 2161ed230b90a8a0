"""Face landmarks and person segmentation by MediaPipe 0.10.21, the last release that carries its models.

478 points: 468 of the face mesh, then an iris centre and four points around it for each eye.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import cv2
import numpy as np

from cap4d.errors import ArgumentError

N_LANDMARKS = 478
IRIS = {"right": 468, "left": 473}  # centre; the four after it lie around it
MAX_CANVAS = 1024  # px; the network looks at 192, more only costs time
WOBBLES = ((0.0, 1.0, 0.0, 0.0), (4.0, 0.94, 9.0, -5.0), (-5.0, 1.06, -7.0, 8.0), (2.0, 0.88, -4.0, -9.0))
"""Rotation deg, scale, shift x, y (thousandths of the canvas) of the copies of an image whose landmarks are
averaged. On a 512 px talking head one copy jitters by 0.21 px, four by 0.15, eight by 0.13."""

_CHATTER = re.compile(
    rb"Created TensorFlow Lite XNNPACK|All log messages before absl::InitializeLog|inference_feedback_manager"
    rb"|landmark_projection_calculator|gl_context|face_landmarker_graph"
)


class Detector:
    """MediaPipe's face mesh and selfie segmentation. Use as a context manager.

    Args:
        video: Images follow each other: the face is searched near where it was.
        copies: Of each image whose landmarks are averaged, 1 to 4; the first is the image as it is.
    """

    def __init__(self, *, video: bool, copies: int = len(WOBBLES)) -> None:
        self._solutions = import_mediapipe().solutions
        settings = dict(static_image_mode=not video, refine_landmarks=True, max_num_faces=1)
        self._meshes = [self._solutions.face_mesh.FaceMesh(**settings) for _ in WOBBLES[:copies]]
        self._segmenter = None

    def __enter__(self) -> Detector:
        return self

    def __exit__(self, *_: object) -> None:
        for graph in self._meshes:
            graph.close()
        if self._segmenter is not None:
            self._segmenter.close()

    def landmarks(self, image: np.ndarray) -> np.ndarray | None:
        """The face in uint8[H, W, 3]: float64[478, 2] px (pixel centres at .5), or None where there is none.

        The mean over wobbled copies of the image in which the face was found.
        """
        found = []
        for mesh, wobble in zip(self._meshes, WOBBLES, strict=False):
            affine, size = _canvas(image.shape[:2], wobble)
            points = _face(mesh, _warped(image, affine, size), size)
            if points is not None:
                found.append((points - affine[:, 2]) @ np.linalg.inv(affine[:, :2]).T)
        return np.mean(found, 0) if found else None

    def matte(self, image: np.ndarray) -> np.ndarray:
        """Coarse coverage of the person, float32[H, W] in [0, 1]: the mean over image and mirror image."""
        affine, size = _canvas(image.shape[:2], WOBBLES[0])
        square = _warped(image, affine, size)
        straight = self._segmentation(square)
        mirrored = self._segmentation(np.ascontiguousarray(square[:, ::-1]))
        mean = (straight + mirrored[:, ::-1]) / 2
        height, width = image.shape[:2]
        inverse = cv2.invertAffineTransform(_corner_based(affine))
        return np.clip(cv2.warpAffine(mean, inverse, (width, height), borderMode=cv2.BORDER_REPLICATE), 0, 1)

    def _segmentation(self, square: np.ndarray) -> np.ndarray:
        if self._segmenter is None:  # who only asks for landmarks does not wait for it
            self._segmenter = self._solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
        return self._segmenter.process(square).segmentation_mask


@contextmanager
def without_native_chatter() -> Iterator[None]:
    """Leaves MediaPipe's known start-up lines out of what goes to stderr meanwhile; all else passes at once.

    They are written by C++ whose logger Python cannot configure.
    """
    sys.stderr.flush()
    original = os.dup(2)
    reading, writing = os.pipe()
    os.dup2(writing, 2)
    os.close(writing)
    sieve = threading.Thread(target=_pass_on, args=(reading, original), daemon=True)
    sieve.start()
    try:
        yield
    finally:
        sys.stderr.flush()
        os.dup2(original, 2)  # closes the pipe's last writing end, which ends the thread
        sieve.join()
        os.close(original)


def _pass_on(reading: int, writing: int) -> None:
    with os.fdopen(reading, "rb") as lines:
        for line in lines:
            if not _CHATTER.search(line):
                os.write(writing, line)


def import_mediapipe() -> ModuleType:
    """MediaPipe with today's protobuf: it asks the message factory for what is now called GetMessageClass.

    The protobuf release notes of 4.22 and 5.26 deprecate and remove `MessageFactory.GetPrototype`.
    """
    try:
        from google.protobuf import message_factory

        if not hasattr(message_factory.MessageFactory, "GetPrototype"):
            message_factory.MessageFactory.GetPrototype = lambda _, descriptor: (
                message_factory.GetMessageClass(descriptor)
            )
        import mediapipe
    except ImportError as error:
        install = "pip install --no-deps mediapipe==0.10.21 (Python 3.9 to 3.12)"
        raise ArgumentError(f"tracking needs MediaPipe: {install}; {error}") from error
    return mediapipe


def _face(mesh, canvas: np.ndarray, size: int) -> np.ndarray | None:
    faces = mesh.process(canvas).multi_face_landmarks
    if not faces:
        return None
    return np.array([(point.x * size, point.y * size) for point in faces[0].landmark])


def _canvas(shape: tuple[int, int], wobble: tuple[float, float, float, float]) -> tuple[np.ndarray, int]:
    """[2, 3] map from image to a square canvas (px from the corner), and the canvas' size.

    Square, because MediaPipe's projection of landmarks is only right for square regions.
    """
    height, width = shape
    size = min(max(height, width), MAX_CANVAS)
    degrees, scale, x, y = wobble
    affine = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, scale * size / max(height, width))
    affine[:, 2] += [size / 2 - width / 2 + x * size / 1000, size / 2 - height / 2 + y * size / 1000]
    return affine, size


def _warped(image: np.ndarray, affine: np.ndarray, size: int) -> np.ndarray:
    flags = cv2.INTER_AREA if affine[0, 0] < 0.5 else cv2.INTER_LINEAR
    return cv2.warpAffine(
        image, _corner_based(affine), (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )


def _corner_based(affine: np.ndarray) -> np.ndarray:
    """The same map for OpenCV, which counts pixels from their centres."""
    shifted = affine.copy()
    shifted[:, 2] += affine[:, :2] @ [0.5, 0.5] - 0.5
    return shifted
