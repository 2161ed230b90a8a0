"""Pictures as JPEG, through the encoder that PyAV brings."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

FULL_RANGE = 2  # AVCOL_RANGE_JPEG


class JpegEncoder:
    """One picture after another; keeps an encoder per size and quantiser, a few of them."""

    KEPT = 16

    def __init__(self) -> None:
        from av.video.reformatter import VideoReformatter

        self._encoders: dict[tuple[int, int, int], object] = {}
        self._reformatter = VideoReformatter()

    def encode(self, image: np.ndarray, quantiser: int) -> bytes:
        """uint8[H, W, 4] sRGB -> a JPEG file with 4:2:0 colour. Alpha is left out.

        Args:
            quantiser: 2 (best) to 31 (smallest).
        """
        import av

        height, width = image.shape[:2]
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgba")
        frame = self._reformatter.reformat(frame, format="yuvj420p", dst_color_range=FULL_RANGE)
        frame.pts = None
        packets = self._encoder(width, height, quantiser).encode(frame)
        return b"".join(bytes(packet) for packet in packets)

    def _encoder(self, width: int, height: int, quantiser: int) -> object:
        key = width, height, quantiser
        if key not in self._encoders:
            if len(self._encoders) >= self.KEPT:
                self._encoders.pop(next(iter(self._encoders)))
            self._encoders[key] = _open(width, height, quantiser)
        return self._encoders[key]


def _open(width: int, height: int, quantiser: int) -> object:
    import av

    context = av.CodecContext.create("mjpeg", "w")
    context.width, context.height, context.pix_fmt = width, height, "yuvj420p"
    context.color_range, context.time_base = FULL_RANGE, Fraction(1, 30)
    context.thread_count = 1  # threads would hold pictures back
    context.options = {"qmin": str(quantiser), "qmax": str(quantiser), "flags": "+qscale"}
    context.open()
    return context
