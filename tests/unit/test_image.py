"""Images survive a round trip, alpha included; what is no image is refused by name."""

import numpy as np
import pytest

from cap4d.errors import ArgumentError, DataError

oiio = pytest.importorskip("OpenImageIO", reason="needs the extra [capture]")

from cap4d.capture.image import composite, read_image, write_image  # noqa: E402


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_eight_bits_come_back_exactly(tmp_path, channels):
    pixels = np.random.default_rng(channels).integers(0, 256, (5, 7, channels), np.uint8)
    write_image(tmp_path / "a.png", pixels)
    read = read_image(tmp_path / "a.png")
    assert read.dtype == np.float32 and read.shape == (5, 7, channels)
    np.testing.assert_array_equal(np.rint(read * 255), pixels)


def test_colours_under_thin_alpha_are_kept(tmp_path):
    pixels = np.full((4, 4, 4), 0.8, np.float32)
    pixels[..., 3] = 1 / 255
    write_image(tmp_path / "a.png", pixels)
    np.testing.assert_allclose(read_image(tmp_path / "a.png")[..., :3], 0.8, atol=0.5 / 255)


def test_floats_are_clipped_and_grey_gets_a_channel(tmp_path):
    write_image(tmp_path / "a.png", np.array([[-1.0, 0.5, 2.0]]))
    np.testing.assert_allclose(read_image(tmp_path / "a.png")[0, :, 0], [0, 0.5, 1], atol=0.5 / 255)


def _with_orientation(path, pixels, orientation):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.UINT8)
    spec.attribute("Orientation", orientation)
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), spec) and target.write_image(pixels) and target.close()


@pytest.mark.parametrize(
    ("orientation", "upright"),
    [
        (1, lambda p: p),
        (2, lambda p: p[:, ::-1]),
        (3, lambda p: np.rot90(p, 2)),
        (4, lambda p: p[::-1]),
        (5, lambda p: p.swapaxes(0, 1)),
        (6, lambda p: np.rot90(p, -1)),
        (7, lambda p: np.rot90(p, 2).swapaxes(0, 1)),
        (8, lambda p: np.rot90(p, 1)),
    ],
)
def test_exif_orientation_is_applied(tmp_path, orientation, upright):
    stored = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)
    _with_orientation(tmp_path / "a.tif", stored, orientation)
    np.testing.assert_array_equal(np.rint(read_image(tmp_path / "a.tif") * 255), upright(stored))


def test_missing_foreign_and_truncated_files_are_refused(tmp_path):
    (tmp_path / "text.png").write_text("not an image")
    write_image(tmp_path / "whole.png", np.random.default_rng(0).random((64, 64, 3)))
    whole = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    for name in ("missing.png", "text.png", "half.png"):
        with pytest.raises(DataError, match=name) as caught:
            read_image(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(DataError):
        write_image(tmp_path / "a.nonsense", np.zeros((2, 2, 3)))
    with pytest.raises(ArgumentError):
        write_image(tmp_path / "a.png", np.full((2, 2), np.nan))
    with pytest.raises(ArgumentError, match="folder does not exist"):
        write_image(tmp_path / "no" / "such" / "a.png", np.zeros((2, 2, 3)))
    assert list(tmp_path.iterdir()) == []


def test_composite_is_white_where_nothing_is():
    image = np.zeros((1, 3, 3), np.float32)
    np.testing.assert_allclose(composite(image, np.array([[0, 0.25, 1.0]]))[0, :, 0], [1, 0.75, 0])
