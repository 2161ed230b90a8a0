"""Reading and writing images through OpenImageIO: float32, straight (unassociated) alpha, upright.

The only place that touches image files. Videos are read in track/video.py and written in player/video.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from cap4d.atomic import replacing
from cap4d.errors import ArgumentError, DataError

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr"})
MAX_PIXELS = 1 << 28  # a larger header is refused before anything is allocated for it


def read_image(path: str | Path) -> np.ndarray:
    """Reads an image as it is meant to be seen: EXIF orientation applied, colours not multiplied by alpha.

    Args:
        path: Any format OpenImageIO knows.
    Returns:
        float32[H, W, C], C as in the file (grey, grey + alpha, RGB, RGBA); [0, 1] for integer formats.
    Raises:
        DataError: The file is missing, not an image, truncated, or larger than 2^28 pixels.
    """
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise DataError(path, "image", expected="a readable image", found=_reason(oiio.geterror()))
    try:
        spec = source.spec()
        if spec.width * spec.height > MAX_PIXELS:
            raise DataError(
                path, "size", expected=f"at most {MAX_PIXELS} pixels", found=f"{spec.width}x{spec.height}"
            )
        pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        if pixels is None or source.has_error:
            raise DataError(path, "pixels", expected="a complete image", found=_reason(source.geterror()))
    finally:
        source.close()
    pixels = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)
    return _upright(pixels, spec.getattribute("Orientation") or 1)


def write_image(path: str | Path, array: np.ndarray) -> None:
    """Writes an image through a temporary file and a rename; integer formats get 8 bits.

    Args:
        path: The suffix names the format.
        array: float[H, W] or [H, W, C] in [0, 1] (clipped), or uint8; C of 2 and 4 end with straight alpha.
    Raises:
        ArgumentError: The array is no image or not finite, or no file can be made at `path`.
        DataError: The format is unknown or holds no such image, or writing fails (a full disk).
    """
    path = Path(path)
    pixels = _as_pixels(array)
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(
        width, height, channels, oiio.UINT8 if path.suffix.lower() != ".exr" else oiio.FLOAT
    )
    spec.attribute("oiio:UnassociatedAlpha", 1)
    with replacing(path) as temporary:
        _write_pixels(temporary, path, spec, pixels)


def composite(image: np.ndarray, alpha: np.ndarray, background: float = 1.0) -> np.ndarray:
    """Straight [H, W, C] over a plain background with coverage [H, W] (fact 40: white)."""
    return image * alpha[..., None] + background * (1 - alpha[..., None])


def _write_pixels(temporary: Path, path: Path, spec: oiio.ImageSpec, pixels: np.ndarray) -> None:
    target = oiio.ImageOutput.create(str(path))  # by the suffix, which `temporary` has not
    if target is None:
        raise DataError(path, "format", expected="an image format", found=_reason(oiio.geterror()))
    done = target.open(str(temporary), spec) and target.write_image(pixels) and target.close()
    if not done:
        raise DataError(path, "image", expected="to be written", found=_reason(target.geterror()))


def _as_pixels(array: np.ndarray) -> np.ndarray:
    pixels = np.asarray(array)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or not 1 <= pixels.shape[2] <= 4 or 0 in pixels.shape:
        raise ArgumentError(
            f"image: expected [H, W] or [H, W, 1..4], got {pixels.dtype}{list(np.shape(array))}"
        )
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype.kind != "f" or not np.isfinite(pixels).all():
        raise ArgumentError(f"image: expected uint8 or finite floats, got {pixels.dtype}")
    return np.ascontiguousarray(np.clip(pixels, 0, 1), np.float32)


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undoes the camera's orientation (EXIF tag 0x0112: 2 mirrored, 3 half turn, 5-8 transposed)."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _reason(message: str) -> str:
    return " ".join(message.split()) or "an unknown error"
