"""Pictures -> a file: H.264 in MP4, numbered PNGs, or one PNG. Files appear whole or not at all."""

from __future__ import annotations

import re
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import numpy as np

from cap4d.atomic import replacing
from cap4d.errors import ArgumentError
from cap4d.player.png import write_png

CRF = "18"  # visually lossless (the released renders use the same, fact 46)
BT709 = 1  # ITU-T H.273: primaries, transfer and matrix
LIMITED_RANGE = 1
NUMBERED = re.compile(r"%0?\d*d")


class VideoWriter:
    """Writes frames to `*.mp4`, to `NAME_%04d.png` (from 0), or the only frame to `*.png`. A context manager.

    Args:
        path: Where to.
        fps: Frames per second of a video.
    Raises:
        ArgumentError: Another kind of file, or its folder does not exist.
    """

    def __init__(self, path: str | Path, *, fps: float) -> None:
        self.path, self.fps, self.frames = Path(path), fps, 0
        if self.path.suffix not in (".mp4", ".png"):
            raise ArgumentError(f"output: expected *.mp4, *.png or frame_%04d.png, got {path}")
        if not self.path.parent.is_dir():
            raise ArgumentError(f"output: the folder of {path} does not exist")
        self._stack = ExitStack()
        self._container = self._stream = None

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._container is not None:
            with self._stack:  # an error on the way here leaves no file
                try:
                    if kind is None:
                        self._container.mux(self._stream.encode(None))
                finally:
                    self._container.close()
                if kind is not None:
                    raise error.with_traceback(trace)

    def write(self, image: np.ndarray) -> None:
        """Appends uint8[H, W, 3 | 4]; a video drops alpha and pads odd sizes by repeating an edge."""
        if self.path.suffix == ".png":
            self._write_png(image)
        else:
            self._write_video(image[..., :3])
        self.frames += 1

    def _write_png(self, image: np.ndarray) -> None:
        numbered = NUMBERED.search(self.path.name) is not None
        if not numbered and self.frames:
            raise ArgumentError(
                f"output: expected frame_%04d.png for more than one frame, got {self.path.name}"
            )
        write_png(self.path.with_name(self.path.name % self.frames) if numbered else self.path, image)

    def _write_video(self, image: np.ndarray) -> None:
        import av
        from av.video.reformatter import ColorRange, Colorspace

        image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
        if self._container is None:
            self._open(image.shape[1], image.shape[0])
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = frame.reformat(
            format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts = self.frames
        self._container.mux(self._stream.encode(frame))

    def _open(self, width: int, height: int) -> None:
        import av

        temporary = self._stack.enter_context(replacing(self.path))
        options = {"movflags": "+faststart"}
        self._container = av.open(str(temporary), "w", format="mp4", options=options)
        rate = Fraction(self.fps).limit_denominator(1001)
        self._stream = stream = self._container.add_stream("libx264", rate=rate, options={"crf": CRF})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.time_base = 1 / rate
        context.color_primaries = context.color_trc = context.colorspace = BT709
        context.color_range = LIMITED_RANGE
