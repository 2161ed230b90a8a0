"""What is tracked: the frames of a video, upright, or the photos of a folder; streamed, never all held."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cap4d.capture.image import IMAGE_SUFFIXES, composite, read_image
from cap4d.capture.video import open_video, video_frames
from cap4d.errors import ArgumentError, DataError

DEFAULT_FPS = 30.0


@dataclass(frozen=True)
class Footage:
    """Images of one person.

    Args:
        source: The video file, or the folder or image the photos came from.
        photos: The image files in order; None for a video.
        fps: Frames per second (of photos: a nominal rate).
        count: Number of frames; for a video the container's estimate, 0 if it has none.
    """

    source: Path
    photos: tuple[Path, ...] | None
    fps: float
    count: int

    @property
    def is_video(self) -> bool:
        """Frames follow each other in time, from one camera."""
        return self.photos is None

    def frames(self) -> Iterator[np.ndarray]:
        """uint8[H, W, 3], upright."""
        return video_frames(self.source) if self.photos is None else map(_photo, self.photos)


def open_footage(source: str | Path) -> Footage:
    """Looks at what `source` is: a folder of images, an image, or a video.

    Raises:
        ArgumentError: There is nothing at `source`.
        DataError: A folder without images, or a file that is neither image nor video.
    """
    source = Path(source)
    if source.is_dir():
        photos = tuple(sorted(f for f in source.iterdir() if _is_image(f)))
        if not photos:
            raise DataError(source, "files", expected="images", found="none")
        return Footage(source, photos, DEFAULT_FPS, len(photos))
    if not source.exists():
        raise ArgumentError(f"{source}: no such video, image or folder")
    if _is_image(source):
        return Footage(source, (source,), DEFAULT_FPS, 1)
    with open_video(source) as container:
        stream = container.streams.video[0]
        return Footage(source, None, float(stream.average_rate or DEFAULT_FPS), stream.frames)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def _photo(path: Path) -> np.ndarray:
    pixels = read_image(path)
    if pixels.shape[2] in (2, 4):
        pixels = composite(pixels[..., :-1], pixels[..., -1])
    rgb = np.broadcast_to(pixels, (*pixels.shape[:2], 3)) if pixels.shape[2] == 1 else pixels
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
