"""The pictures of a video file, upright; streamed, never all held."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np

from cap4d.errors import DataError


def open_video(path: Path) -> av.container.InputContainer:
    """A file with pictures in it, to be closed.

    Raises:
        DataError: There is no such video.
    """
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        raise DataError(path, "video", expected="a readable video", found=error.strerror) from error
    if not container.streams.video:
        container.close()
        raise DataError(path, "video", expected="a video stream", found="none")
    return container


def video_frames(path: Path) -> Iterator[np.ndarray]:
    """uint8[H, W, 3]. A display matrix (phones write one) turns a frame anticlockwise by `rotation` degrees.

    Raises:
        DataError: There is no such video, or it does not decode to its end.
    """
    with open_video(path) as container:
        try:
            for frame in container.decode(video=0):
                quarters = round(frame.rotation / 90) % 4
                yield np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), quarters))
        except av.FFmpegError as error:
            raise DataError(path, "video", expected="frames that decode", found=error.strerror) from error
