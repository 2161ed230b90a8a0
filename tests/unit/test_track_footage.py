"""Videos come upright, photos as they are meant to be seen, and what is neither is refused in one line."""

import numpy as np
import pytest

from cap4d.errors import ArgumentError, DataError

av = pytest.importorskip("av")
for module in ("OpenImageIO", "torch", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from cap4d.capture.image import write_image  # noqa: E402
from cap4d.track.footage import open_footage  # noqa: E402

HEIGHT, WIDTH, FRAMES = 32, 64, 5


def _picture(t):
    """Red in the left half, brighter every frame."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, : WIDTH // 2, 0] = 100 + 30 * t
    return picture


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for t in range(FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(_picture(t), format="rgb24")))
        container.mux(stream.encode())
    return path


def _turn(path, matrix):
    """Writes a display matrix (16.16 fixed point) into the track header, as phones do."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    data[start : start + 16] = np.array([matrix[0], matrix[1], 0, matrix[2]], ">i4").tobytes()
    data[start + 16 : start + 20] = np.array([matrix[3]], ">i4").tobytes()
    path.write_bytes(data)


def test_video_frames_in_order(video):
    footage = open_footage(video)
    frames = list(footage.frames())
    assert (footage.is_video, footage.fps, footage.count, len(frames)) == (True, 25.0, FRAMES, FRAMES)
    assert frames[0].shape == (HEIGHT, WIDTH, 3) and frames[0].dtype == np.uint8
    assert all(abs(int(f[16, 8, 0]) - int(_picture(t)[16, 8, 0])) < 12 for t, f in enumerate(frames))


ONE = 1 << 16


@pytest.mark.parametrize(
    ("matrix", "upright"),
    [((0, ONE, -ONE, 0), -1), ((-ONE, 0, 0, -ONE), 2), ((0, -ONE, ONE, 0), 1)],
    ids=["clockwise", "half", "counterclockwise"],
)
def test_display_matrix_is_honoured(video, matrix, upright):
    _turn(video, matrix)
    frame = next(open_footage(video).frames())
    expected = np.rot90(_picture(0), upright)
    assert frame.shape == expected.shape
    assert np.abs(frame.astype(int) - expected).mean() < 12


def test_folder_of_photos_sorted_with_alpha_on_white(tmp_path):
    write_image(tmp_path / "b.png", np.zeros((4, 6, 3)))
    write_image(tmp_path / "a.png", np.concatenate([np.zeros((2, 2, 3)), np.zeros((2, 2, 1))], -1))
    write_image(tmp_path / "c.png", np.full((3, 3), 0.5))
    (tmp_path / "notes.txt").write_text("no image")
    footage = open_footage(tmp_path)
    photos = list(footage.frames())
    assert not footage.is_video and [p.shape for p in photos] == [(2, 2, 3), (4, 6, 3), (3, 3, 3)]
    assert (photos[0] == 255).all() and (photos[1] == 0).all() and (photos[2] == 128).all()


def test_one_image_is_a_folder_of_one(tmp_path):
    write_image(tmp_path / "a.png", np.zeros((4, 6, 3)))
    assert [f.shape for f in open_footage(tmp_path / "a.png").frames()] == [(4, 6, 3)]


def test_what_is_no_footage_is_refused(tmp_path, video):
    with pytest.raises(ArgumentError):
        open_footage(tmp_path / "missing.mp4")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="images"):
        open_footage(tmp_path / "empty")
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(DataError, match=r"text\.mp4: video") as caught:
        open_footage(tmp_path / "text.mp4")
    assert "\n" not in str(caught.value)
