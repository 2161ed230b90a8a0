"""MediaPipe starts silently, but nothing else that is said gets lost."""

import os
import subprocess
import sys

import numpy as np
import pytest

for module in ("OpenImageIO", "torch", "cv2"):
    pytest.importorskip(module, reason="needs the extra [track]")

from cap4d.track.landmarks import WOBBLES, _canvas, _warped, without_native_chatter  # noqa: E402


def test_only_known_chatter_is_held_back(capfd):
    with without_native_chatter():
        os.write(2, b"INFO: Created TensorFlow Lite XNNPACK delegate for CPU.\n")
        os.write(2, b"out of memory\n")
        sys.stderr.write("from Python\n")  # in one piece: the other lines come from another thread
    os.write(2, b"afterwards\n")
    said = capfd.readouterr().err
    assert "TensorFlow" not in said
    assert sorted(said.split("\n")) == ["", "afterwards", "from Python", "out of memory"]


def test_stderr_comes_back_after_an_error(capfd):
    with pytest.raises(KeyError), without_native_chatter():
        raise KeyError
    os.write(2, b"still here\n")
    assert "still here" in capfd.readouterr().err


def test_mediapipe_starts_without_a_word():
    pytest.importorskip("mediapipe", reason="needs mediapipe")
    code = (
        "import numpy as np\n"
        "from cap4d.track.landmarks import Detector, without_native_chatter\n"
        "with without_native_chatter(), Detector(video=False) as detector:\n"
        "    assert detector.landmarks(np.zeros((64, 48, 3), np.uint8)) is None\n"
        "    assert detector.matte(np.zeros((64, 48, 3), np.uint8)).shape == (64, 48)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "")


@pytest.mark.parametrize("wobble", WOBBLES)
def test_the_canvas_puts_points_where_it_puts_pixels(wobble):
    image = np.zeros((120, 200, 3), np.uint8)
    image[70:73, 120:123] = 255
    affine, size = _canvas(image.shape[:2], wobble)
    canvas = _warped(image, affine, size)[..., 0].astype(float)
    rows, columns = np.indices(canvas.shape) + 0.5
    centre = np.array([(columns * canvas).sum(), (rows * canvas).sum()]) / canvas.sum()
    np.testing.assert_allclose(centre, affine @ [121.5, 71.5, 1], atol=0.1)
