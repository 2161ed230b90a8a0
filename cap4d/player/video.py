"""Pictures, with sound when there is some -> a file: H.264 in MP4, numbered PNGs, or one PNG.

Files appear whole or not at all.
"""

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
from cap4d.player.sound import Sound
from cap4d.player.soundtrack import Soundtrack

CRF = "18"  # visually lossless (the released renders use the same, fact 46)
PRESET = "medium"  # of x264
BT709 = 1  # ITU-T H.273: primaries, transfer and matrix
LIMITED_RANGE = 1
NUMBERED = re.compile(r"%0?\d?d")
MAX_SIDE = 8192  # px, of a video; libx264 refuses 16384x16384
MIN_FPS = 1e-3  # of a video: rates are fractions, and slower ones would become 0


class VideoWriter:
    """Writes frames to `*.mp4`, to `NAME_%04d.png` (from 0), or the only frame to `*.png`. A context manager.

    Args:
        path: Where to.
        fps: Frames per second of a video.
        sound: Of a video; it is cut, or silence follows it, where the pictures end.
        preset: x264's; faster ones make larger files.
    Raises:
        ArgumentError: See `check_output`.
    """

    def __init__(
        self, path: str | Path, *, fps: float, sound: Sound | None = None, preset: str = PRESET
    ) -> None:
        self.path, self.fps, self.frames = Path(path), fps, 0
        check_output(self.path, fps=fps, sound=sound is not None)
        self._sound, self._preset = sound, preset
        self._stack = ExitStack()
        self._container = self._stream = None
        self._track: Soundtrack | None = None

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
                        if self._track is not None:
                            self._track.end()
                finally:
                    self._container.close()
                if kind is not None:
                    raise error.with_traceback(trace)

    def write(self, image: np.ndarray, *, sound_at: float | None = None) -> None:
        """Appends uint8[H, W, 3 | 4]; a video drops alpha and pads odd sizes by repeating an edge.

        Args:
            sound_at: Where the sound is at this picture, s; None: where this picture is in the video; NaN:
                the picture is silent. See `Soundtrack.write`.
        """
        if self.path.suffix == ".png":
            self._write_png(image)
        else:
            self._write_video(image)
        self.frames += 1
        if self._track is not None:
            self._track.write(self.frames, sound_at)

    def _write_png(self, image: np.ndarray) -> None:
        check_output(self.path, fps=self.fps, frames=self.frames + 1)
        numbered = NUMBERED.search(self.path.name) is not None
        write_png(self.path.with_name(self.path.name % self.frames) if numbered else self.path, image)

    def _write_video(self, image: np.ndarray) -> None:
        import av
        from av.video.reformatter import ColorRange, Colorspace

        check_output(self.path, fps=self.fps, size=(image.shape[1], image.shape[0]))
        odd = image.shape[0] % 2, image.shape[1] % 2
        if any(odd):
            image = np.pad(image, ((0, odd[0]), (0, odd[1]), (0, 0)), mode="edge")
        if self._container is None:
            self._open(image.shape[1], image.shape[0])
        layout = "rgba" if image.shape[2] == 4 else "rgb24"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=layout)
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
        settings = {"crf": CRF, "preset": self._preset}
        self._stream = stream = self._container.add_stream("libx264", rate=rate, options=settings)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.time_base = 1 / rate
        context.color_primaries = context.color_trc = context.colorspace = BT709
        context.color_range = LIMITED_RANGE
        if self._sound is not None:
            self._track = Soundtrack(self._container, self._sound, rate)


def check_output(
    path: Path, *, fps: float, frames: int = 1, size: tuple[int, int] = (1, 1), sound: bool = False
) -> None:
    """Refuses what cannot be written, before it is drawn.

    Args:
        path: As of `VideoWriter`.
        fps: Frames per second of a video.
        frames: How many there will be.
        size: (width, height) px of each.
        sound: Whether there is to be sound.
    Raises:
        ArgumentError: Another kind of file, its folder does not exist, it is a folder itself, or it cannot
            hold so many frames, such large ones, such slow ones, or sound.
    """
    check_file(path, "output")
    if path.suffix == ".png":
        if sound:
            raise ArgumentError(f"audio: expected *.mp4 for pictures with sound, got {path}")
        _check_png_name(path.name, frames)
    elif path.suffix != ".mp4":
        raise ArgumentError(f"output: expected *.mp4, *.png or frame_%04d.png, got {path}")
    elif max(size) > MAX_SIDE:
        found = f"{size[0]}x{size[1]}"
        raise ArgumentError(f"output: expected at most {MAX_SIDE} px a side for a video, got {found}")
    elif not fps >= MIN_FPS:
        raise ArgumentError(f"output: expected at least {MIN_FPS} frames per second of a video, got {fps:g}")


def check_file(path: Path, what: str) -> None:
    """Raises ArgumentError where no file `path` can be: its folder does not exist, or it is a folder."""
    if not path.parent.is_dir():
        raise ArgumentError(f"{what}: the folder of {path} does not exist")
    if path.is_dir():
        raise ArgumentError(f"{what}: expected a file, {path} is a folder")


def _check_png_name(name: str, frames: int) -> None:
    numbers = len(NUMBERED.findall(name))
    if numbers > 1 or (numbers == 1 and name.count("%") > 1):
        raise ArgumentError(f"output: expected one number such as %04d and no other %, got {name}")
    if numbers == 0 and frames > 1:
        raise ArgumentError(f"output: expected frame_%04d.png for more than one frame, got {name}")
