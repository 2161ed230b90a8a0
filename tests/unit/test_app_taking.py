"""Screenshots and recordings: what is in the files, and what is said of them."""

import numpy as np
import pytest
from cap4d.app.background import Backdrop, Checkerboard
from cap4d.app.canvas import Canvas
from cap4d.app.taking import Taking
from test_app_viewer import files, messages, show  # noqa: F401  fixtures

HALF = np.tile(np.uint8([100, 50, 0, 128]), (32, 48, 1))  # premultiplied


def decoded(path):
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgba") for frame in container.decode(video=0)]


@pytest.fixture
def taking(show, tmp_path):  # noqa: F811
    made = Taking(show(), tmp_path)
    yield made
    made.close()


def test_a_screenshot_is_named_after_its_avatar_and_numbered(taking, tmp_path):
    opaque = HALF.copy()
    opaque[..., 3] = 255
    for _ in range(2):
        taking.screenshot(opaque, is_transparent=False)
        taking.viewer.poll()
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["tiny_0001.png", "tiny_0002.png"]
    assert decoded(tmp_path / "tiny_0001.png")[0][0, 0].tolist() == [100, 50, 0, 255]
    assert "tiny_0002.png" in messages(taking.viewer)[-1]


def test_on_a_checkerboard_it_keeps_its_alpha(taking, tmp_path):
    assert taking.behind(Checkerboard()) is None
    assert taking.behind((1, 0, 0)) == (1, 0, 0)
    taking.screenshot(HALF, is_transparent=True)
    taking.viewer.poll()
    assert decoded(tmp_path / "tiny_0001.png")[0][0, 0].tolist() == [199, 100, 0, 128]


def test_a_recording_starts_goes_on_and_ends(taking, tmp_path):
    viewer = taking.viewer
    taking.add(HALF)  # nothing records yet
    taking.toggle_recording((49, 33))
    assert viewer.recording_since == viewer.now
    for _ in range(4):
        taking.add(HALF)
        viewer.clock.now += 0.1
    taking.toggle_recording((49, 33))
    viewer.poll()
    assert viewer.recording_since is None
    pictures = decoded(tmp_path / "tiny_0001.mp4")
    assert pictures[0].shape == (32, 48, 4)
    assert len(pictures) == 10  # 0.3 s at 30 a second, and the last one
    assert "tiny_0001.mp4" in messages(viewer)[-1]


def test_a_recording_of_nothing_leaves_nothing(taking, tmp_path):
    taking.toggle_recording((48, 32))
    taking.toggle_recording((48, 32))
    taking.viewer.poll()
    assert not list(tmp_path.glob("*.mp4"))
    assert messages(taking.viewer) == ["Nothing was recorded"]


def test_a_folder_that_is_gone_is_a_message(taking, tmp_path):
    taking.folder = tmp_path / "gone"
    taking.toggle_recording((48, 32))
    taking.screenshot(HALF, is_transparent=True)
    taking.viewer.poll()
    assert taking.recorder is None
    (toast,) = taking.viewer.toasts.current(taking.viewer.now)
    assert toast.count == 2
    assert "gone" in toast.text


def test_closing_the_program_finishes_the_file(taking, tmp_path):
    taking.toggle_recording((48, 32))
    taking.add(HALF)
    taking.close()
    assert len(decoded(tmp_path / "tiny_0001.mp4")) == 1


def test_a_canvas_has_its_first_row_on_top_and_any_size(ctx):
    picture = HALF.copy()
    picture[:16] = [0, 200, 0, 255]
    texture, canvas = ctx.texture((48, 32), 4, picture.tobytes()), Canvas(ctx)
    for size in ((48, 32), (1, 1), (47, 31)):
        canvas.draw(texture, (1.0, 1.0, 1.0), size)
        assert canvas.read().shape == (size[1], size[0], 4)
    canvas.draw(texture, (1.0, 1.0, 1.0), (48, 32))
    assert canvas.read()[0, 0].tolist() == [0, 200, 0, 255]
    assert canvas.read()[-1, 0].tolist() == pytest.approx([227, 177, 127, 255], abs=1)
    canvas.draw(texture, None, (48, 32))
    np.testing.assert_array_equal(canvas.read(), picture)
    assert isinstance(canvas.backdrop, Backdrop)
