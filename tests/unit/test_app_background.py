"""Backgrounds: what is read from files, and what is drawn behind a picture."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import av
import numpy as np
import pytest
from cap4d.app import background as background_module
from cap4d.app.background import CHECK_PX, Backdrop, Checkerboard, Picture, cover
from cap4d.app.renderers import CpuRenderer, GlRenderer
from cap4d.app.screenshot import save_screenshot, straight
from tiny_bundle import tiny_bundle

from cap4d.errors import ArgumentError, DataError
from cap4d.player.avatar import Avatar
from cap4d.player.png import encode_png, write_png


def save_with_av(path: Path, image: np.ndarray, codec: str, pixel_format: str) -> Path:
    with av.open(str(path), "w", format="image2") as file:
        stream = file.add_stream(codec, rate=1)
        stream.height, stream.width, stream.pix_fmt = *image.shape[:2], pixel_format
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixel_format)
        file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


def halves(width: int = 64, height: int = 32) -> np.ndarray:
    """Red on the left, blue on the right."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = image[:, width // 2 :, 2] = 250
    return image


# Files


def test_a_png_is_read_exactly(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(256, size=(7, 5, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(Picture.load(tmp_path / "a.png").pixels, image)


@pytest.mark.parametrize(
    ("name", "codec", "layout"), [("a.jpg", "mjpeg", "yuvj444p"), ("a.bmp", "bmp", "bgr24")]
)
def test_other_formats_are_read(name: str, codec: str, layout: str, tmp_path: Path) -> None:
    found = Picture.load(save_with_av(tmp_path / name, halves(), codec, layout)).pixels.astype(int)
    assert np.abs(found - halves()).max() <= 12


def test_what_is_transparent_is_white(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.uint8([[[0, 0, 0, 0], [100, 50, 0, 255], [0, 0, 0, 51]]]))
    assert Picture.load(tmp_path / "a.png").pixels.tolist() == [[[255] * 3, [100, 50, 0], [204] * 3]]


def test_large_images_are_kept_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background_module, "MAX_SIDE", 32)
    write_png(tmp_path / "a.png", halves(128, 64))
    found = Picture.load(tmp_path / "a.png").pixels
    assert found.shape == (16, 32, 3) and found[8, 4].tolist() == pytest.approx([250, 0, 0], abs=3)


def test_photos_are_turned_upright(tmp_path: Path) -> None:
    """As their EXIF says: red was on the left before."""
    photo = save_with_av(tmp_path / "a.jpg", halves(), "mjpeg", "yuvj444p").read_bytes()
    for orientation, red in ((1, (16, 8)), (3, (16, 56)), (6, (8, 16)), (8, (56, 16))):
        entry = struct.pack(">HHHIHH", 1, 0x112, 3, 1, orientation, 0)
        exif = b"Exif\0\0MM\0*\0\0\0\x08" + entry + bytes(4)
        segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
        (tmp_path / "b.jpg").write_bytes(photo[:2] + segment + photo[2:])
        assert Picture.load(tmp_path / "b.jpg").pixels[red].argmax() == 0


def bomb(side: int) -> bytes:
    """A PNG of `side`^2 black pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1000 * (1 + 3 * side)), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [9000, 60_000, 2**31 - 1])
def test_a_bomb_is_refused_before_it_is_decoded(side: int, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(bomb(9000)[:16] + struct.pack(">II", side, side) + bomb(9000)[24:])
    with pytest.raises(DataError, match=r"a\.png: "):
        Picture.load(tmp_path / "a.png")


PNG = encode_png(halves())


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG\r\n\x1a\n", PNG[:40], b"GIF89a" + PNG, b"<svg/>", b"\xff\xd8\xff"]
)
def test_what_is_no_image_is_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(DataError, match=r"a\.png: .*expected"):
        Picture.load(tmp_path / "a.png")


def test_no_file_and_no_pixels_are_argument_errors(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="expected an image file"):
        Picture.load(tmp_path / "none.png")
    with pytest.raises(ArgumentError, match="uint8"):
        Picture(np.zeros((0, 4, 3), np.uint8))


def test_an_image_covers() -> None:
    assert cover((200, 100), (50, 50)) == (0.5, 1)
    assert cover((100, 100), (200, 100)) == (1, 0.5)
    assert cover((30, 20), (60, 40)) == (1, 1)


# Pictures


def laid(ctx, picture: np.ndarray, background, *, upright: bool = False) -> np.ndarray:
    """uint8[H, W, 4]: a premultiplied uint8[H, W, 4] over a background."""
    size = picture.shape[1::-1]
    texture, target = ctx.texture(size, 4, picture.tobytes()), ctx.simple_framebuffer(size)
    target.use()
    Backdrop(ctx).draw(texture, background, upright=upright)
    return np.frombuffer(target.read(components=4), np.uint8).reshape(picture.shape)


def clear(width: int = 48, height: int = 48) -> np.ndarray:
    return np.zeros((height, width, 4), np.uint8)


def test_a_colour_stands_behind_what_is_transparent(ctx) -> None:
    picture = clear()
    picture[:24] = 60, 30, 0, 128
    found = laid(ctx, picture, (1.0, 0.5, 0.0))
    assert found[40, 5].tolist() == [255, 128, 0, 255]
    np.testing.assert_allclose(found[5, 5], [60 + 127, 30 + 64, 0, 255], atol=1)
    assert np.array_equal(laid(ctx, picture, (1.0, 0.5, 0.0), upright=True), found[::-1])


def test_no_background_leaves_the_picture_as_it_is(ctx) -> None:
    picture = np.random.default_rng(0).integers(256, size=(9, 7, 4), dtype=np.uint8)
    assert np.array_equal(laid(ctx, picture, None), picture)


def test_the_checkerboard_has_squares_of_two_greys(ctx) -> None:
    found = laid(ctx, clear(), Checkerboard())[..., 0]
    middles = found[CHECK_PX // 2 :: CHECK_PX, CHECK_PX // 2 :: CHECK_PX]
    assert middles.tolist() == [[219, 250] * 2, [250, 219] * 2] * 2
    assert (found[:CHECK_PX, :CHECK_PX] == 219).all()


def test_an_image_is_upright_and_cut_to_the_middle(ctx) -> None:
    quarters = np.zeros((40, 80, 3), np.uint8)
    quarters[:20, 20:40], quarters[:20, 40:60], quarters[20:, 20:60] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    found = laid(ctx, clear(), Picture(quarters))
    for (row, column), colour in {(8, 8): 0, (8, 40): 1, (40, 8): 2, (40, 40): 2}.items():
        assert found[row, column, :3].argmax() == colour and found[row, column, 3] == 255


def test_images_of_odd_widths_and_one_pixel(ctx) -> None:
    assert (
        laid(ctx, clear(), Picture(np.full((3, 5, 3), 77, np.uint8)))[..., :3].tolist()
        == [[[77] * 3] * 48] * 48
    )
    assert laid(ctx, clear(1, 1), Picture(np.full((1, 1, 3), 9, np.uint8))).tolist() == [[[9, 9, 9, 255]]]


def test_a_screenshot_without_a_background_has_straight_alpha(ctx, tmp_path: Path) -> None:
    avatar = Avatar(tiny_bundle(network=False))
    frame, camera = avatar.idle.frame(3), avatar.camera.resized(70, 50)
    expected = avatar.splat(avatar.move(frame), camera).astype(int)
    for renderer in (GlRenderer(ctx, avatar), CpuRenderer(ctx, avatar, background=None)):
        picture = renderer.texture(frame, camera)
        target = ctx.simple_framebuffer((70, 50))
        target.use()
        Backdrop(ctx).draw(picture, None)
        image = np.frombuffer(target.read(components=4), np.uint8).reshape(50, 70, 4)
        path = save_screenshot(tmp_path, straight(image), name=renderer.name)
        with av.open(str(path)) as file:
            found = next(file.decode(video=0)).to_ndarray(format="rgba").astype(int)
        assert np.abs(found[..., 3] - expected[..., 3]).max() <= 2
        solid = expected[..., 3] > 100  # a level of a premultiplied colour is more of a faint one
        assert np.abs(found - expected)[solid].max() <= 4 and (found[..., 3] == 0).any()


def test_both_backends_give_premultiplied_pictures(ctx) -> None:
    avatar = Avatar(tiny_bundle(network=False))
    frame, camera = avatar.idle.frame(3), avatar.camera.resized(70, 50)
    gl, cpu = GlRenderer(ctx, avatar), CpuRenderer(ctx, avatar, background=None)
    ours = np.frombuffer(cpu.texture(frame, camera).read(), np.uint8).reshape(50, 70, 4) / 255
    gl.texture(frame, camera)
    theirs = gl.splats.read()
    assert 0.05 < (ours[..., 3] > 0.5).mean() < 0.9
    np.testing.assert_allclose(ours, np.clip(theirs, 0, 1), atol=2 / 255)
    np.testing.assert_array_equal(gl.vertices, cpu.vertices)
    baked = CpuRenderer(ctx, avatar).texture(frame, camera)
    expected = np.frombuffer(baked.read(), np.uint8).reshape(50, 70, 4)
    over = laid(ctx, np.rint(255 * ours).astype(np.uint8), (1.0, 1.0, 1.0))
    assert np.abs(over.astype(int) - expected).max() <= 2
